"""What a scene looks like: each view rendered once by exact plugins, kept in a folder, gone on with if interrupted."""

from __future__ import annotations

import gc
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from .. import __version__, plugins, scenes
from ..files import replacing, writable_folder
from ..measure.store import fingerprint
from ..plugins.support import footprint
from ..tasks import disney
from .recipe import View, ViewDistribution
from .rig import Rig

#: Samples of the whole image in one pass; what is interrupted loses a pass at most.
PASS = 1 << 23

#: Seeds of references are this and above, those of trained renders below.
SEEDS = 1 << 31


def colours(image):
    """An image, an array or a tensor ``(height, width, channels)``, without transparency and what else is no colour."""
    found = image.shape[2]
    wanted = 3 if found >= 3 else 1
    return image if found == wanted else image[:, :, :wanted]


@dataclass
class ReferenceRenders:
    """
    Images of the views of a scene file with exact plugins, or those that ``against`` names, at ``spp`` samples a pixel.
    ``folder``, which is made if its parent exists, keeps a file for each (``None``: nothing is kept), under a name that
    changes with whatever an image depends on: the scene, the files that it names but those ``without`` any influence,
    such as the table that is trained, ``inputs`` (texts that stand for further ones), the view, the samples, versions
    and the code of plugins. Files are replaced in one piece, after each pass.

    Raises :class:`~mi_diffind.scenes.SceneError` and :class:`~mi_diffind.files.OutputError`.
    """

    scene: str | os.PathLike
    views: ViewDistribution
    spp: int
    folder: str | os.PathLike | None = None
    defines: dict[str, str] | None = None
    against: str = "exact"
    without: Sequence[Path] = ()
    inputs: Sequence[str] = ()
    progress: bool = True
    #: Passes that were rendered, and those that were there already.
    rendered: int = 0
    found: int = 0
    _loaded: tuple | None = field(default=None, repr=False)

    def __post_init__(self):
        if self.folder is not None:
            self.folder = writable_folder(self.folder, create=True)
        self.digest = self._digest()

    def _digest(self) -> str:
        """Of all that the images of all views have in common."""
        code = [*Path(plugins.__file__).resolve().parent.rglob("*.py"), *Path(disney.__file__).parent.glob("*.py")]
        common = {
            "defines": dict(sorted((self.defines or {}).items())), "against": self.against, "inputs": list(self.inputs),
            "spp": self.spp, "target": self.views.target, "up": self.views.up, "variant": mi.variant(),
            "versions": [mi.__version__, __version__, fingerprint(code)], "pass": PASS,
        }  # fmt: skip
        digest = hashlib.sha256(json.dumps(common).encode())
        for file in scenes.files_of(self.scene, self.defines):
            if file not in self.without:
                digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
        return digest.hexdigest()

    def path(self, view: View) -> Path | None:
        """The file of a view, if files are kept."""
        return None if self.folder is None else self.folder / f"{self._key(view)[:24]}.npz"

    def _key(self, view: View) -> str:
        return hashlib.sha256((self.digest + json.dumps(asdict(view))).encode()).hexdigest()

    def images(self, views: Sequence[View]) -> list[np.ndarray]:
        """
        The linear images, ``(height, width, channels)``, float32; what is missing is rendered. The exact scene is gone
        then: Dr.Jit compiles the materials of all scenes that there are into every kernel.
        """
        bar = tqdm(total=len(views) * self.spp, desc="references", unit="spp", disable=None if self.progress else True)
        try:
            with bar:
                return [self._image(view, bar) for view in views]
        finally:
            self._loaded = None
            gc.collect()

    def _image(self, view: View, bar: tqdm) -> np.ndarray:
        path = self.path(view)
        total, done = self._kept(path)
        self.found += done > 0
        bar.update(done)
        if done < self.spp:
            scene, rig, samples = self._scene()
            rig.place(view)
            footprint.attach(scene, 0, self.spp)
            seed = int(self._key(view)[:8], 16) % 2**19 << 12
            while done < self.spp:
                n = min(samples, self.spp - done)
                # The number of the pass by what is done: the same again after an interruption
                image = scenes.render_pass(scene, n, SEEDS + seed + done // samples % 2**12)
                total = total + n * np.where(np.isfinite(image), image, 0)
                done += n
                self.rendered += 1
                bar.update(n)
                if path is not None:
                    with replacing(path) as temporary:
                        np.savez(temporary, total=total, done=np.int64(done))
        return colours((total / done).astype(np.float32))

    def _kept(self, path: Path | None) -> tuple:
        """The sum of the samples that are kept for a view, and their number; a damaged file counts as none."""
        if path is None or not path.is_file():
            return 0.0, 0
        try:
            with np.load(path, allow_pickle=False) as data:
                total, done = data["total"], int(data["done"])
        except Exception:  # zipfile and numpy each have their own for a damaged file
            return 0.0, 0
        return (total, done) if total.ndim == 3 and 0 < done <= self.spp else (0.0, 0)

    def _scene(self) -> tuple:
        """The exact scene, loaded when it is needed, what moves it, and the samples of a pixel in one pass."""
        if self._loaded is None:
            scene = scenes.load(self.scene, exact=True, defines=self.defines, against=self.against)
            width, height = scene.sensors()[0].film().crop_size()
            self._loaded = scene, Rig(scene, self.views), max(1, PASS // int(width * height))
        return self._loaded
