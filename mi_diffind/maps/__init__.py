"""Images and the maps of materials, which several tasks store.

- :mod:`.source`: reads an image, or the maps of a manifest; :mod:`.layout`: chooses the stored channels.
- :mod:`.pyramid`: mip pyramids; :mod:`.components`: borders, smaller versions and principal components.
- :mod:`.compressed`: maps that are read from arrays; :mod:`.model`: their table files; :mod:`.arguments`: options.
"""
