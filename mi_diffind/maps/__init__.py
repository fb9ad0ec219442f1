"""
Images and the maps of materials, which several tasks store: where they come from and what of them is stored.

- :mod:`.source`: an image, or the maps that a manifest lists; :mod:`.layout`: which of their channels are stored;
- :mod:`.components`: borders, smaller versions and principal components of them;
- :mod:`.compressed`: maps that are read from arrays, decoded and measured, however the arrays are laid out.
"""
