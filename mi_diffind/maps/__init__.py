"""Images and the maps of materials, which several tasks store.

- :mod:`.source`: reads an image, a manifest, or the entries (:mod:`.entries`) that :mod:`.names` finds in a folder,
  :mod:`.gltf` and :mod:`.materialx` in files of materials; :mod:`.layout`: chooses the stored channels.
- :mod:`.pyramid`: mip pyramids; :mod:`.components`: borders, smaller versions and principal components.
- :mod:`.compressed`: maps that are read from arrays; :mod:`.model`: their table files; :mod:`.arguments`: options.
- :mod:`.search`: the smallest file of a wanted quality.
"""
