"""Reference images of a scene: each view rendered once by exact plugins, in two halves, and kept in a folder."""

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

#: Samples per pixel of the first passes if time is limited; later ones are half as long as all before.
SHORT = 2


@dataclass
class ReferenceRenders:
    """Images of the views of a scene, rendered with exact plugins at ``spp`` samples a pixel.

    Each image is the mean of two halves of the samples. An error that is measured with one half is independent of the
    noise of the other.

    ``against`` names other counterparts than the exact ones. ``folder`` (created if its parent exists; ``None``: keep
    nothing) holds one file for each image. The name of a file depends on everything that the image depends on: the
    scene and the files that it names, except those ``without`` influence, such as the table that is trained;
    ``inputs``, texts that stand for further files; the view, the samples, versions, and the code of plugins and of the
    rig. Files are replaced in one piece, after each pass. ``pass_samples``: samples of the whole image in one pass.

    With a ``deadline``, each view gets an equal part of the time, and as many samples as fit; such images are not
    kept. ``samples`` is the number of samples that all images of ``spp`` have.

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
            "target": self.views.target, "up": self.views.up, "variant": mi.variant(),
            "versions": [mi.__version__, __version__, fingerprint(code)], "pass": self.pass_samples,
        }  # fmt: skip
        digest = hashlib.sha256((json.dumps(common) + self.scene.description).encode())
        for file in self.scene.files():
            if file not in self.without:
                digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
        return digest.hexdigest()

    def path(self, view: View, spp: int | None = None) -> Path | None:
        """Return the file of a view at ``spp`` samples, ``None`` if files are not kept."""
        return None if self.folder is None else self.folder / f"{self._key(view, spp or self.spp)[:24]}.npz"

    def _key(self, view: View, spp: int) -> str:
        return hashlib.sha256((self.digest + json.dumps([asdict(view), spp])).encode()).hexdigest()

    def images(self, views: Sequence[View]) -> list[np.ndarray]:
        """Return the linear images, ``(height, width, channels)``, float32; missing ones are rendered."""
        return [halves.mean(axis=0) for halves in self.halves([(view, self.spp) for view in views])]

    def halves(self, views: Sequence[tuple[View, int]]) -> list[np.ndarray]:
        """Return both halves of the images of pairs (view, samples a pixel), ``(2, height, width, channels)``.

        The exact scene is dropped afterwards: Dr.Jit compiles the materials of all loaded scenes into every kernel.
        """
        if (self.workers or self.scheduler) and self.deadline is None and not self.scene.description:
            return self._halves_by_workers(views)
        bar = progress_bar("references", sum(spp for _, spp in views), "spp", self.progress)
        try:
            with bar:
                return [self._halves(*pair, bar, len(views) - i) for i, pair in enumerate(views)]
        finally:
            self._loaded = None
            gc.collect()

    def _halves_by_workers(self, views: Sequence[tuple[View, int]]) -> list[np.ndarray]:
        """Return :meth:`halves`, rendered by other processes. Raises :class:`.errors.DiffindError` if one fails."""
        given = {name: getattr(self, name) for name in SHARED}
        given["folder"] = self.folder and self.folder.resolve()
        content = pickle.dumps((str(self.scene.path.resolve()), self.scene.defines, mi.variant(), given))
        jobs = {self._key(*pair): (content, *pair) for pair in views}
        images = {}
        options = (self.workers, self.scheduler, self.progress, "references", "view")
        for outcome in run_jobs(render_separately, jobs, *options):
            if outcome.failure:
                raise DiffindError(f"references: {outcome.failure}")
            images[outcome.name], rendered, reused = outcome.value
            self.rendered, self.reused = self.rendered + rendered, self.reused + reused
        if len(images) < len(jobs):
            raise KeyboardInterrupt
        return [images[self._key(*pair)] for pair in views]

    def _halves(self, view: View, spp: int, bar, left: int) -> np.ndarray:
        """Return both halves of the image of a view; ``left`` views, this one included, share the time that is left."""
        path, half = self.path(view, spp), -(-spp // 2)
        total, done = self._kept(path, half)
        self.reused += done[0] > 0
        bar.update(sum(done))
        if min(done) < half:
            scene, rig, samples = self._scene()
            deadline = None if self.deadline is None else self.deadline.part(1 / left)
            if deadline is not None:
                path, total, done = None, None, [0, 0]
            rig.place(view)
            footprint.attach(scene, 0, spp)
            seed = int(self._key(view, spp)[:8], 16) % 2**19 << 12
            while min(done) < half and not (deadline is not None and deadline.passed and done[0] == done[1] > 0):
                i = int(done[0] > done[1])
                n, unit = min(samples, half - done[i]), samples
                if deadline is not None:
                    n, unit = min(n, max(SHORT, done[i] // 2)), SHORT
                # The pass number follows from the finished samples: the same after an interruption
                image = loading.render_pass(scene, n, SEEDS + seed + (2 * (done[i] // unit) + i) % 2**12)
                total = np.zeros((2, *image.shape), image.dtype) if total is None else total
                total[i] += n * np.where(np.isfinite(image), image, 0)
                done[i] += n
                self.rendered += 1
                bar.update(n)
                if path is not None:
                    with replacing(path) as temporary:
                        np.savez(temporary, total=total, done=np.array(done))
        if spp == self.spp:
            self.samples = min(self.samples, sum(done))
        return np.stack([loading.colour_channels((total[i] / done[i]).astype(np.float32)) for i in range(2)])

    def _kept(self, path: Path | None, half: int) -> tuple[np.ndarray | None, list[int]]:
        """Return the sums of the kept samples of both halves, and their numbers; a damaged file counts as none."""
        if path is not None and path.is_file():
            with contextlib.suppress(Exception), Archive(path) as archive:  # zipfile and numpy each have their own
                total, done = archive.array("total"), [int(n) for n in archive.array("done")]
                if total.ndim == 4 and len(total) == len(done) == 2 and 0 < done[0] <= half and 0 <= done[1] <= half:
                    return np.array(total), done
        return None, [0, 0]

    def _scene(self) -> tuple:
        """Return the exact scene, loaded on the first call, its rig, and the samples per pixel of one pass."""
        if self._loaded is None:
            scene = self.scene.load(exact=True, against=self.against, parallel=False)
            width, height = loading.film_size(scene)
            self._loaded = scene, Rig(scene, self.views), max(1, self.pass_samples // (width * height))
        return self._loaded


#: Fields that the references of other processes share.
SHARED = ("views", "spp", "folder", "against", "without", "inputs", "pass_samples")


def render_separately(job: tuple[bytes, View, int]) -> tuple[np.ndarray, int, int]:
    """Return both halves of the image of a view, and the numbers of passes and kept images, in another process.

    The process loads the scene once.
    """
    content, view, spp = job
    references = _references(content)
    references.rendered = references.reused = 0
    halves = references._halves(view, spp, progress_bar(None, spp, progress=False), 1)
    return halves, references.rendered, references.reused


@functools.lru_cache(maxsize=1)
def _references(content: bytes) -> ReferenceRenders:
    path, defines, variant, given = pickle.loads(content)
    use_variant(variant)
    return ReferenceRenders(loading.ParsedScene(path, defines), **given, progress=False)
