"""Study ``tradeoff image``: quality of a compressed image or material against bytes.

At each compression ratio, arrays that ``fit image`` trains are compared with codecs (:mod:`.baselines.codecs`) at the
largest size that is not above, and at the first ratio with a hash grid and network; BC7 has one size. Reads are timed
by ``tradeoff cost``, in renders.

Errors are those of the values in the source's files; FLIP is a mean over maps, each shown as a picture. Materials with
normals or roughness are also compared as they are seen (:mod:`mi_diffind.maps.as_seen`).
"""

from pathlib import Path

import numpy as np

from ..core.runtime import array_module
from ..images import metrics
from ..maps import as_seen
from ..maps.source import Source
from ..measure.study import Measure, Plan
from ..measure.training import Contender
from .baselines import codecs
from .materials import Levels, MaterialContenders, MaterialStudy, level_errors

MEASURES = (
    Measure("PSNR, dB", "psnr_db"),
    Measure("between texels", "psnr_between_db"),
    Measure("FLIP", "flip", ".4f", False),
    Measure("as seen", "seen_db"),
)


class ImageStudy(MaterialStudy):
    """Quality of a compressed image or material against bytes."""

    name = "image"
    title = "a compressed image or material, in equal bytes"

    def plan(self, arguments) -> Plan:
        context = ImageContenders(arguments.loaded, arguments.source, self.settings(arguments))
        compressions = context.settings.compressions
        jobs = [*map(context.trained, compressions), *context.network_contenders(1)]
        for codec in context.codecs:
            jobs += [context.codec(codec, ratio) for ratio in (compressions[:1] if codec == "bc7" else compressions)]
        note = f"{context.note} PSNR of all channels together. JPEG and WebP have no random access."
        return Plan(
            study=self.name,
            title=f"Compressed image {Path(context.name).stem}: error against bytes",
            candidates=[job.candidate(competes="no random" not in job.label, label=job.name) for job in jobs],
            cases=[],
            details=context.details,
            notes=[note, *codecs.install_notes()],
            jobs=jobs,
            jobs_fingerprint=context.source.digest,
            panels=("bytes",),
            measures=MEASURES,
        )


STUDY = ImageStudy()


class ImageContenders(MaterialContenders):
    """Contenders of an image or material at its finest level; JPEG and WebP are files."""

    task = "image"

    def record(self, nbytes: int, seconds: float | None, levels: Levels, **details) -> dict:
        errors = map_errors(self.source, {name: images[0] for name, images in levels.items()})
        details["ratio"] = self.source.nbytes / nbytes
        return {"bytes": nbytes, "seconds": seconds, "errors": errors, "details": details}

    def codec(self, codec: str, compression: float) -> Contender:
        """Return the contender of a codec: all maps together take at most the bytes of a ratio, but for BC7."""

        def encode() -> dict[str, codecs.Encoded]:
            images = {m.name: np.clip(m.values, 0, 1) for m in self.source.maps}
            nbytes = self.source.nbytes / compression
            if codec == "astc":  # coarser levels are resolutions to choose from
                return self.astc({n: [image, *self.levels[n][1:]] for n, image in images.items()}, nbytes, False)
            if codec == "bc7":
                return {name: codecs.bc7(image) for name, image in images.items()}
            share = nbytes / self.source.channels
            return {n: codecs.image_file(codec, image, int(share * image.shape[-1])) for n, image in images.items()}

        title, budget = codecs.TITLES[codec], 0.0 if codec == "bc7" else compression
        name = f"{title} {budget:g}x" if budget else title
        return self.encoded(name, title, budget, encode, title + " (no random access)" * (codec in ("jpeg", "webp")))


def map_errors(source: Source, maps: dict[str, np.ndarray]) -> dict:
    """Return the errors of decoded maps, rounded to 8 bits, of a source that is clipped to [0, 1].

    ``psnr_db`` is that of all channels together, ``psnr_between_db`` that of bilinear reads, one in each texel, without
    rounding, and ``flip`` the mean of all maps. Errors as seen are those of :func:`.as_seen.compare`.
    """
    truth = {m.name: np.clip(m.values, 0, 1) for m in source.maps}
    maps = {name: np.clip(maps[name], 0, 1).astype(np.float32) for name in truth}
    rounded = {name: np.rint(255 * image) / np.float32(255) for name, image in maps.items()}

    def flip(reference: np.ndarray, image: np.ndarray) -> float:
        shown = [0, 1, 2] if image.shape[-1] > 2 else [0, 0, 0]
        return metrics.flip_shown(reference[..., shown], image[..., shown])

    def psnr(*images: dict[str, np.ndarray]) -> float:
        return level_errors(*({name: [image] for name, image in each.items()} for each in images))[0]

    return {
        "psnr_db": psnr(truth, rounded),
        "psnr_between_db": psnr(*({n: between_texels(image) for n, image in each.items()} for each in (truth, maps))),
        "flip": float(np.mean([flip(truth[name], image) for name, image in rounded.items()])),
        **as_seen.compare(source, maps, array_module()),
    }


def between_texels(image: np.ndarray) -> np.ndarray:
    """Return bilinear reads of an image that repeats, at one random place in each texel."""
    a, b = np.random.default_rng(2023).random((2, *image.shape[:2], 1), dtype=np.float32)
    image = (1 - a) * image + a * np.roll(image, -1, axis=0)
    return (1 - b) * image + b * np.roll(image, -1, axis=1)
