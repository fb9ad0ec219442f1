from __future__ import annotations  # Delayed parsing of type annotations

import drjit as dr
import mitsuba as mi

from . import Plugin
from .filtered_texture import FilteredTexture
from .support import textures
from .support.image_files import SharedMaps, open_uncompressed


class MipMap(FilteredTexture):
    """TODO"""

    def _open(self, props: mi.Properties) -> SharedMaps:
        found, self._path = open_uncompressed(props, self.wrap_mode)
        #: For functions that are frozen, which look for the arrays that they read in here.
        self.texels = found.image.arrays
        return found

    def _read(self, uv):
        return self._used_of(self._interpolated(uv, mi.Float(0), whole=True))

    def _filtered(self, uv, level):
        return self._interpolated(uv, level, whole=False)

    def _rounded(self, uv, level, sample):
        return self._interpolated(uv, dr.floor(self.image.clamped(level, mi.Float) + sample), whole=True)

    def _interpolated(self, uv, level, whole: bool) -> list:
        """What can be averaged: linear values where there are any."""
        found = self.image.interpolated(*self._wrapped_at(uv, level), level, whole=whole)
        return [found[i] for i in self._needed()]

    def _used_of(self, values):
        stored = [None] * self.image.layout.stored
        for i, value in zip(self._needed(), values, strict=True):
            stored[i] = value
        if not (self._is_encoded() and self.image.is_linear(self.map.name)):
            return self._used(self.image.encoded(stored))
        return [
            mi.Float(stored[where]) if isinstance(where, int) else textures.linear(mi.Float(where[1]), True)
            for where in self.map.where
        ]

    def _storage(self):
        return {"preset": "", "storage": "float32", "table_bytes": self.image.memory_nbytes}


PLUGIN = Plugin("mipmap", "texture", MipMap)
