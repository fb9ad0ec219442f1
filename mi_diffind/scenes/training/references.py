"""Reference images of a scene: each view rendered once by exact plugins, and kept in a folder."""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import inspect
import json
import pickle
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from ... import __version__, plugins
from ...core.archives import Archive
from ...core.errors import DiffindError
from ...core.files import replacing, writable_folder
from ...core.jobs import run_jobs
from ...core.progress import Deadline, progress_bar
from ...core.runtime import use_variant
from ...measure.store import fingerprint
from ...plugins.support import footprint
from ...tasks import disney
from .. import loading
from .options import View, ViewDistribution
from .rig import Rig

#: Samples of the whole image in one pass; an interruption loses one pass at most.
PASS = 1 << 23

#: First seed of references; trained renders use smaller ones.
SEEDS = 1 << 31

#: Samples per pixel of a pass if time is limited.
SHORT = 4


@dataclass
class ReferenceRenders:
    """Images of the views of a scene, rendered with exact plugins at ``spp`` samples a pixel.

    ``against`` names other counterparts than the exact ones. ``folder`` (created if its parent exists; ``None``: keep
    nothing) holds one file for each image. The name of a file depends on everything that the image depends on: the
    scene and the files that it names, except those ``without`` influence, such as the table that is trained;
    ``inputs``, texts that stand for further files; the view, the samples, versions, and the code of plugins and of the
    rig. Files are replaced in one piece, after each pass. ``pass_samples``: samples of the whole image in one pass.

    With a ``deadline``, each view gets an equal part of the time, and as many samples as fit; such images are not
    kept. ``samples`` is the number of samples that all images have.

    ``workers`` processes share the views of a scene file, or those of the Dask cluster ``scheduler``.

    Raises :class:`.SceneError` and :class:`.OutputError`.
    """

    scene: loading.ParsedScene
    views: ViewDistribution
    spp: int
    folder: str | Path | None = None
    against: str = "exact"
    without: Sequence[Path] = ()
    inputs: Sequence[str] = ()
    progress: bool = True
    pass_samples: int = PASS
    deadline: Deadline | None = None
    workers: int | None = None
    scheduler: str = ""
    #: Number of passes that were rendered, and of images that were kept from an earlier run.
    rendered: int = 0
    reused: int = 0
    _loaded: tuple | None = field(default=None, repr=False)

    def __post_init__(self):
        if self.folder is not None:
            self.folder = writable_folder(self.folder, create=True)
        self.digest, self.samples = self._digest(), self.spp

    def _digest(self) -> str:
        """Return a hash of everything that the images of all views depend on."""
        code = [*Path(plugins.__file__).resolve().parent.rglob("*.py"), *Path(disney.__file__).parent.glob("*.py")]
        code.append(Path(inspect.getfile(Rig)))
        common = {
            "defines": dict(sorted(self.scene.defines.items())), "against": self.against, "inputs": list(self.inputs),
            "spp": self.spp, "target": self.views.target, "up": self.views.up, "variant": mi.variant(),
            "versions": [mi.__version__, __version__, fingerprint(code)], "pass": self.pass_samples,
        }  # fmt: skip
        digest = hashlib.sha256((json.dumps(common) + self.scene.description).encode())
        for file in self.scene.files():
            if file not in self.without:
                digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
        return digest.hexdigest()

    def path(self, view: View) -> Path | None:
        """Return the file of a view, ``None`` if files are not kept."""
        return None if self.folder is None else self.folder / f"{self._key(view)[:24]}.npz"

    def _key(self, view: View) -> str:
        return hashlib.sha256((self.digest + json.dumps(asdict(view))).encode()).hexdigest()

    def images(self, views: Sequence[View]) -> list[np.ndarray]:
        """Return the linear images, ``(height, width, channels)``, float32; missing ones are rendered.

        The exact scene is dropped afterwards: Dr.Jit compiles the materials of all loaded scenes into every kernel.
        """
        if (self.workers or self.scheduler) and self.deadline is None and not self.scene.description:
            return self._images_by_workers(views)
        bar = progress_bar("references", len(views) * self.spp, "spp", self.progress)
        try:
            with bar:
                return [self._image(view, bar, len(views) - i) for i, view in enumerate(views)]
        finally:
            self._loaded = None
            gc.collect()

    def _images_by_workers(self, views: Sequence[View]) -> list[np.ndarray]:
        """Return the images, rendered by other processes. Raises :class:`.errors.DiffindError` if one fails."""
        given = {name: getattr(self, name) for name in SHARED}
        given["folder"] = self.folder and self.folder.resolve()
        content = pickle.dumps((str(self.scene.path.resolve()), self.scene.defines, mi.variant(), given))
        jobs = {self._key(view): (content, view) for view in views}
        images = {}
        options = (self.workers, self.scheduler, self.progress, "references", "view")
        for outcome in run_jobs(render_separately, jobs, *options):
            if outcome.failure:
                raise DiffindError(f"references: {outcome.failure}")
            images[outcome.name], rendered, reused = outcome.value
            self.rendered, self.reused = self.rendered + rendered, self.reused + reused
        if len(images) < len(jobs):
            raise KeyboardInterrupt
        return [images[self._key(view)] for view in views]

    def _image(self, view: View, bar, left: int) -> np.ndarray:
        """Return the image of a view; ``left`` views, this one included, share the time that is left."""
        path = self.path(view)
        total, done = self._kept(path)
        self.reused += done > 0
        bar.update(done)
        if done < self.spp:
            scene, rig, samples = self._scene()
            deadline = None if self.deadline is None else self.deadline.part(1 / left)
            if deadline is not None:
                path, samples, total, done = None, min(samples, SHORT), 0.0, 0
            rig.place(view)
            footprint.attach(scene, 0, self.spp)
            seed = int(self._key(view)[:8], 16) % 2**19 << 12
            while done < self.spp and not (done and deadline is not None and deadline.passed):
                n = min(samples, self.spp - done)
                # The pass number follows from the finished samples: the same after an interruption
                image = loading.render_pass(scene, n, SEEDS + seed + done // samples % 2**12)
                total = total + n * np.where(np.isfinite(image), image, 0)
                done += n
                self.rendered += 1
                bar.update(n)
                if path is not None:
                    with replacing(path) as temporary:
                        np.savez(temporary, total=total, done=np.int64(done))
        self.samples = min(self.samples, done)
        return loading.colour_channels((total / done).astype(np.float32))

    def _kept(self, path: Path | None) -> tuple:
        """Return the sum of the kept samples of a view, and their number; a damaged file counts as none."""
        if path is not None and path.is_file():
            with contextlib.suppress(Exception), Archive(path) as archive:  # zipfile and numpy each have their own
                total, done = archive.array("total"), int(archive.array("done"))
                if total.ndim == 3 and 0 < done <= self.spp:
                    return total, done
        return 0.0, 0

    def _scene(self) -> tuple:
        """Return the exact scene, loaded on the first call, its rig, and the samples per pixel of one pass."""
        if self._loaded is None:
            scene = self.scene.load(exact=True, against=self.against, parallel=False)
            width, height = loading.film_size(scene)
            self._loaded = scene, Rig(scene, self.views), max(1, self.pass_samples // (width * height))
        return self._loaded


#: Fields that the references of other processes share.
SHARED = ("views", "spp", "folder", "against", "without", "inputs", "pass_samples")


def render_separately(job: tuple[bytes, View]) -> tuple[np.ndarray, int, int]:
    """Return the image of a view, and the numbers of passes and kept images, in a process that loads the scene once."""
    content, view = job
    references = _references(content)
    references.rendered = references.reused = 0
    image = references._image(view, progress_bar(None, references.spp, progress=False), 1)
    return image, references.rendered, references.reused


@functools.lru_cache(maxsize=1)
def _references(content: bytes) -> ReferenceRenders:
    path, defines, variant, given = pickle.loads(content)
    use_variant(variant)
    return ReferenceRenders(loading.ParsedScene(path, defines), **given, progress=False)
