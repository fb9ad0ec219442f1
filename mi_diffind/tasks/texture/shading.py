"""Training of task 5: arrays of a texture, trained for their shaded appearance.

- **Weights.** Shading multiplies an error of a normal by more than one of a colour: by how much,
  :func:`sensitivities` measures. Arrays are laid out and trained anew for weighted maps.
- **Appearance.** The loss is (1 − λ) · texture + λ · shading. The first term is the loss of task 4, in the units of its
  recipe. The second compares shaded values with a reference that shades first and filters afterwards
  (:mod:`.appearance`).
- **Choice.** Held-out footprints (:mod:`.heldout`) decide which arrays are kept, and at which level bias they are read.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import numpy as np

from ...arrays import lookup
from ...arrays.indirection import aligned_copy, device_array, unfolded
from ...arrays.tables import Table
from ...core.progress import interruptible
from ...fitting.loop import FitResult, all_cores, sample_losses
from ...fitting.task import FitRequest, FitSettings, Stage, significant
from ...maps.pyramid import Pyramid
from ...maps.source import Source
from ..disney.decoder import Decoder
from . import PRESETS as TEXTURES
from . import ShadingSettings
from . import training as textures
from .appearance import TRUTHS, ShadedEvaluation, places_in_footprints, reader, reference, share_of_bias, write_preview
from .compressed import CompressedTexture, neutral_extras, to_table
from .heldout import (
    LIGHTS,
    SKY,
    HeldOutFootprints,
    compared,
    loss_or_gain,
    mean_of_skies,
    mirrored_pairs,
    relative_weights,
    sky_weight,
    stretched_views,
    under_skies,
)
from .surface import frozen_decoder, maps_of, material_effects, shaded, surface_of

#: Factor of the number of shaded samples from one level to the next coarser one, up to level :data:`TOP`.
FALL = 0.7
TOP = 9

#: Level biases that are compared.
BIASES = (0.0, -0.5)

#: Level bias of the training for appearance, and of the comparison of arrays to begin it with.
TRAINED_BIAS = -0.5

#: Powers of the maps' sensitivities that are tried as weights, and the share of the steps of each short training.
POWERS = (0.5, 1.0)
TRIAL = 0.1

#: Share of the steps of the training for weighted maps, if there is one; the rest is that for appearance.
WEIGHTED = 0.5

#: Shares of the way from the arrays before to those after the training for appearance that are compared.
WAYS = tuple(n / 8 for n in range(1, 9))

#: Reads along each side of a pixel with four samples.
QUARTERS = 2

#: Least weight of a map: errors of maps that hardly matter would grow beyond small ones.
LEAST_WEIGHT = 0.01

#: Pairs of a texel and of directions by which sensitivities are measured, and the difference of a value.
TRIED = 2**19
DIFFERENCE = 0.02

#: Seed of sensitivities.
SEED = 20231214


def sensitivities(pyramid: Pyramid, exposure: float = 1.0, skies: float = 1.0) -> dict[str, float]:
    """Return the mean squared change of a shaded value by the change of a map's value, by map, at level 0.

    Exposed values are compared up to 1, under single lights and, with the weight ``skies``, under uniform skies, as
    those of held-out footprints. Maps that shading does not read are left out.
    """
    types, layout, effects = pyramid.types, pyramid.layout, material_effects(pyramid.layout)[0]
    rng = np.random.default_rng(SEED)
    numbers = [types.Float(aligned_copy(rng.random(TRIED, dtype=np.float32))) for _ in range(7)]
    u, v, *numbers = under_skies(types, dr.arange(types.UInt32, TRIED) < TRIED // 2, numbers)
    wi, wo, weight = mirrored_pairs(types, numbers)
    stored = [x + dr.zeros(types.Float, TRIED) for x in pyramid.stored(u, v)]
    dr.eval(stored, wi, wo, weight)

    def values(channels: list) -> list:
        value = weight * shaded(Decoder(), surface_of(pyramid, channels), wi, wo, effects)
        half = np.split(np.array(value), 2, axis=1)
        of_sky = half[0].reshape(3, -1, SKY).mean(axis=2)
        return [np.minimum(exposure * x, 1) for x in (of_sky, half[1])]

    result, before = {}, values(stored)
    for m in maps_of(layout).values():
        channels = {i for i in m.where if isinstance(i, int)}
        # Channels of a normal are independent, those of other maps change together
        groups = [{i} for i in sorted(channels)] if m.role == "normal" else [channels]
        changes = [[x + DIFFERENCE if i in group else x for i, x in enumerate(stored)] for group in groups if group]
        squared = []
        for changed in changes:
            of_sky, single = (np.square(a - b).sum(axis=0).mean() for a, b in zip(values(changed), before, strict=True))
            squared.append(single + skies * of_sky)
        if squared:
            result[m.name] = float(np.mean(squared)) / DIFFERENCE**2
    return result


def map_weights(measured: dict[str, float], layout, power: float) -> dict[str, float]:
    """Return weights of maps, with a mean of 1: ``power`` of sensitivities; maps without one have the least weight."""
    mean = max(np.mean([*measured.values()]), 1e-12)
    weights = {name: max(value / mean, LEAST_WEIGHT) ** power for name, value in measured.items()}
    weights = {name: weights.get(name, min(weights.values())) for name in layout.names}
    return {name: float(value / np.mean([*weights.values()])) for name, value in weights.items()}


class ShadingProblem(textures.TextureProblem):
    """Training problem of shaded appearance.

    ``net`` reads the stored channels, ``pyramid`` is the truth of the maps. The gain of ``held_out`` footprints over
    ``base``, their errors before the training, decides which state is the best (``None``: the PSNR of the texture
    decides). They also weight the errors of a ``rendered`` recipe. Shaded values are read with the recipe's level bias,
    the texture's loss is that of the levels as they are stored.
    """

    #: Tolerance of the PSNR of shaded images, dB.
    tolerance = 0.02

    def __init__(
        self, net, pyramid: Pyramid, recipe: ShadingSettings, digest: str = "",
        held_out: HeldOutFootprints | None = None, base: list | None = None,
    ):  # fmt: skip
        super().__init__(net, pyramid, TEXTURES[recipe.texture], digest)
        self.shading, self.held_out, self.base = recipe, held_out, base
        self.level_bias = recipe.level_bias or 0.0
        self.beta_2 = recipe.beta_2 if recipe.share > 0 else self.beta_2
        #: Picture that is written at each measurement, and the images that it shows a part of
        self.preview: tuple[Path, ShadedEvaluation] | None = None
        self.effects, _ = material_effects(pyramid.layout)
        exposures, weights = np.ones(LIGHTS), np.ones((2, 1, LIGHTS))
        if held_out is not None and recipe.rendered:
            single = 1 - recipe.skies
            shares = single * (1 - recipe.mirrored), single * recipe.mirrored, recipe.skies
            exposures, weights = held_out.exposures, relative_weights(base, shares, FALL)
        #: Exposures by kind of light, and weights of errors by level and kind of light, of one and of four reads
        self.exposures = device_array(self.types.Float, exposures)
        self.error_weights = [device_array(self.types.Float, w) for w in weights]
        self.decoder = frozen_decoder(self.types) if recipe.tables else Decoder()
        self.identity = {**self.identity, "shading": recipe.further}

    def loss(self, net, rng, size: int):
        net, share = self.seen(unfolded(net)), self.shading.share
        losses = []
        if share < 1:
            inputs, targets = self.batch(rng, size)
            weights = {name: (1 - share) * weight for name, weight in self.weights.items()}
            losses += sample_losses(self.read(net, inputs), targets, weights, size, self.recipe.loss)
        if share > 0:
            losses.append(share / size * self.shading_errors(net, rng, size))
        return losses

    def shading_errors(self, net, rng, size: int):
        """Return the errors of ``size`` shaded reads, the mean over colours; ``net`` is as training sees it.

        They are of footprints that are read at their centre. In each second step of a ``rendered`` recipe, they are of
        pixels with four samples: each is the mean of reads a level finer, one in each quarter. The first lanes are of
        skies.
        """
        recipe, types = self.shading, self.types
        reads = QUARTERS**2 if recipe.rendered and self.jittered else 1
        count = size // reads
        sky = dr.arange(types.UInt32, count) < int(recipe.skies * count / SKY) * SKY
        numbers = under_skies(types, sky, [rng.random(types.Float, count) for _ in range(9)])
        u, v, level = self.places(*numbers[:3])
        stretch, *views = stretched_views(types, *numbers[3:6]) if recipe.rendered else (1, *numbers[4:6])
        stretch += dr.zeros(types.Float, count)
        wi, wo, weight = mirrored_pairs(types, [*views, *numbers[6:]], recipe.mirrored)
        lights = dr.select(sky, LIGHTS - 1, types.UInt32(numbers[-1] < recipe.mirrored))
        weights = self.error_weights[int(reads > 1)]
        row = dr.minimum(types.UInt32(level), len(weights) // LIGHTS - 1)
        weight *= dr.gather(types.Float, weights, row * LIGHTS + lights)
        exposure = dr.gather(types.Float, self.exposures, lights)
        with all_cores():
            truth = reference(recipe.reference, self.pyramid, u, v, level, wi, wo, self.effects, rng, stretch=stretch)
            dr.eval(u, v, level, stretch, wi, wo, weight, exposure, truth)
        if reads > 1:
            lane = dr.arange(types.UInt32, count * reads)
            pixel, read = lane // reads, lane % reads
            u, v, level, stretch, wi, wo = (dr.gather(type(x), x, pixel) for x in (u, v, level, stretch, wi, wo))
            inside = [
                (types.Float(n) + rng.random(types.Float, count * reads)) / QUARTERS
                for n in (read % QUARTERS, read // QUARTERS)
            ]
            u, v = places_in_footprints(self.pyramid, u, v, level, *inside, stretch)
            level = level - math.log2(QUARTERS)
        if self.level_bias or reads > 1:  # opaque, so that one kernel serves all
            bias = dr.opaque(types.Float, self.level_bias) * share_of_bias(stretch)
            level = lookup.clamp(level + bias, 0.0, float(len(self.sizes) - 1))
        surface = surface_of(self.pyramid, net.filtered(u, v, level), net.extra(u, v, level))
        limit = None if recipe.clip is None else recipe.clip * recipe.share / size
        value = shaded(self.decoder, surface, wi, wo, self.effects, limit)
        with all_cores():
            dr.eval(value)  # all three at once: a sum over blocks evaluates what it is given
        if reads > 1:
            value = [dr.block_reduce(dr.ReduceOp.Add, c, reads) / reads for c in value]
        if recipe.skies:
            value, truth = ([mean_of_skies(sky, c) for c in x] for x in (value, truth))

        def bounded(x):  # logarithmic above 1: a rare highlight cannot dominate the loss
            return dr.select(x > 1, 1 + dr.log(dr.maximum(x, 1)), x) if recipe.bounded else x

        errors = [bounded(a * exposure) - bounded(b * exposure) for a, b in zip(value, truth, strict=True)]
        squared = self.settings.loss == "mse"
        return reads * weight * sum(dr.square(e) if squared else dr.abs(e) for e in errors) / 3

    def places(self, u, v, level) -> tuple:
        """Return ``(u, v, level)`` of uniform numbers; the density falls by :data:`FALL` from one level to the next."""
        lowest = FALL ** min(len(self.sizes) - 1, TOP)
        return u, v, dr.log(1 - (1 - lowest) * level) * (1 / math.log(FALL))

    def measure(self, net) -> dict[str, float]:
        """Return the mean gain of held-out footprints, entries rounded, and the PSNR of the texture."""
        texture = super().measure(net)
        if self.held_out is None:
            return texture
        maps = CompressedTexture(self.pyramid.layout, textures.rounded(unfolded(net)), self.level_bias)
        read = reader(maps, self.effects)
        with all_cores():
            if self.preview is not None:
                write_preview(*self.preview, read)
            gain = compared(self.base, self.held_out.errors(read))[0].mean()
        return {"gain_db": float(gain), **{f"texture_{name}": value for name, value in texture.items()}}


def trainable_arrays(table: Table, pyramid: Pyramid):
    """Return the arrays of a trained texture for further training. Raises ``ValueError`` for other channels."""
    texture = CompressedTexture.from_table(table, pyramid.types.TensorXf, "float32")
    if texture.layout != pyramid.layout:
        raise ValueError(f"{table.path}: stores other channels than a training of this source would")
    return texture.net


class TrainedState(NamedTuple):
    """Arrays that may be kept: their name, the texture with its level bias, and its gain over the start.

    ``gain`` and ``mean`` are those of :func:`.heldout.loss_or_gain`.
    """

    name: str
    texture: CompressedTexture
    gain: float
    mean: float


@dataclasses.dataclass
class ShadingTraining:
    """Trainings of arrays of ``source`` for shading, and the ``states`` among which held-out footprints choose.

    ``start`` are the :func:`trainable_arrays` of a texture, read with its level bias ``start_bias``. ``build(weights)``
    returns the problem of training arrays of the same bytes anew for weighted maps (``None``: that is not tried).
    ``preview`` is a picture of the ``evaluation`` that is written at each measurement.
    """

    source: Source
    start: object
    recipe: ShadingSettings
    request: FitRequest
    pyramid: Pyramid
    evaluation: ShadedEvaluation
    preview: Path | None = None
    start_bias: float = 0.0
    build: Callable[[dict[str, float]], textures.TextureProblem] | None = None

    def __post_init__(self):
        self.effects, self.layout = material_effects(self.pyramid.layout)[0], self.pyramid.layout
        self.first = CompressedTexture(self.layout, textures.stored_form(self.start), self.start_bias)
        bias = self.recipe.level_bias
        self.biases = BIASES if bias is None else (bias,)
        # Every fourth one if time is limited: comparisons take it from trainings
        self.ways = WAYS if self.request.deadline is None else WAYS[3::4]
        self.trained_bias = TRAINED_BIAS if bias is None else bias
        self.states, self.begin = [TrainedState("start", self.first, 0.0, 0.0)], []
        #: Name, first arrays and problem of the training in progress, which Ctrl-C may end
        self.in_progress: tuple | None = None

    def fit(self) -> tuple[Table, FitResult]:
        """Train, and return the table with the errors as a texture and as shaded images, and its record.

        If no state gains without a loss somewhere, the table holds the start (setting ``kept_start``). The setting
        ``before`` has the errors of the start as shaded images, ``states`` the gains of all states.
        """
        recipe, request, source = self.recipe, self.request, self.source
        result, best = self.run()
        kept = best is self.states[0]
        identity = {"source": source.digest, **TEXTURES[recipe.texture].further, "shading": recipe.further}
        gains = {state.name: round(state.gain, 3) for state in self.states}
        recorded = dataclasses.replace(request, settings=recipe).recorded(result)
        settings = {**recorded, **identity, "level_bias": best.texture.level_bias, "state": best.name}
        settings |= {"states": gains, **({"kept_start": True} if kept else {})}
        table = to_table(best.texture, settings)
        table.preset, table.seed = request.preset, recipe.seed
        texture = CompressedTexture.from_table(table, request.types.TensorXf)
        table.settings["before"] = significant(self.before)
        after = self.before if kept else self.errors(texture)
        table.measured = significant({**after, **texture.measure(source)})
        return table, result

    def run(self) -> tuple[FitResult, TrainedState]:
        """Carry out all trainings; return the record and the best state."""
        with interruptible() as self.stop:
            self.held_out = HeldOutFootprints(self.pyramid, self.effects)
            count = len(self.biases) * len(self.ways)
            self.base = self.request.rehearse(lambda: self.footprint_errors(self.first), count)
            self.before = self.errors(self.first)
            results = self.request.run(self.stages())
        result = results[-1] if results else FitResult({}, 0, 0, 0.0, interrupted=True, restarts=0)
        if self.in_progress is not None:
            self.add_ways()
        best = choose(self.states)
        result = dataclasses.replace(
            result, measured={"gain_db": best.mean}, step=result.step * best.name.startswith("appearance"),
            history=[figures for figures in result.history if "gain_db" in figures],
        )  # fmt: skip
        return result, best

    def stages(self) -> Iterator[Stage]:
        """Yield the trainings: short ones for weights, the one for weighted maps, and the one for appearance."""
        self.add("finer level", self.start)
        if self.stop.is_set():
            return
        rest, chosen, weighted = 1.0, self.begin[0], None
        if self.build is not None:
            measured, trials = sensitivities(self.pyramid, self.held_out.exposures[0], sky_weight(self.base)), []
            for power in POWERS:
                problem = self.build(map_weights(measured, self.layout, power))
                yield Stage("trial", problem, TRIAL, self.part(problem.recipe, TRIAL), resumable=False)
                texture = CompressedTexture(self.layout, textures.stored_form(problem.net), self.trained_bias)
                trials.append((loss_or_gain(self.base, self.footprint_errors(texture))[1], power))
            weighted, rest = self.build(map_weights(measured, self.layout, max(trials)[1])), 1 - WEIGHTED
            yield Stage("weights", weighted, WEIGHTED, self.part(weighted.recipe, WEIGHTED))
            self.add("weights", weighted.net)
            chosen = max(self.begin, key=lambda state: state.mean)
        for name, state in {"appearance": chosen, "appearance of the start": self.begin[0]}.items():
            problem = self.appearance_problem(state.texture)
            if state.name == "weights":
                problem.weights = weighted.weights
            self.in_progress = name, problem.net.changed(lambda array, bits: array.copy()), problem
            settings = self.part(self.recipe, rest if state is chosen else rest / 2)
            yield Stage(name.replace(" ", "-"), problem, 1.0, settings, name, lambda: self.errors(self.first))
            self.add_ways()
            # Anew only if weighted maps lost somewhere that shading did not win back, and time is not over
            gained = choose(self.states) not in self.states[:2]
            if chosen is self.begin[0] or gained or self.request.deadline is not None:
                break

    def part(self, settings: FitSettings, share: float) -> FitSettings:
        """Return ``settings`` with a ``share`` of the steps, and a batch that is not larger than the recipe's."""
        steps, recipe = max(1, round(share * self.recipe.steps)), self.recipe
        every = max(1, min(recipe.measure_every, steps // 2))
        batch = min(settings.batch, recipe.batch)
        return dataclasses.replace(
            settings, steps=steps, batch=batch, measure_every=every, seed=recipe.seed,
            deterministic=recipe.deterministic,
        )  # fmt: skip

    def footprint_errors(self, texture: CompressedTexture) -> list[list[np.ndarray]]:
        """Return the errors of held-out footprints (:meth:`.HeldOutFootprints.errors`)."""
        return self.held_out.errors(reader(texture, self.effects))

    def errors(self, texture: CompressedTexture) -> dict[str, float]:
        """Return the errors of shaded images, ``shaded_TRUTH_db``."""
        measured = self.evaluation.measure(reader(texture, self.effects), flip=False)
        return {f"shaded_{TRUTHS[k]}_db": f["mean_db"] for k, f in measured.items()}

    def add(self, name: str, net) -> None:
        """Add the state of arrays at the level bias of its largest gain."""
        tried, stored = [], textures.stored_form(net)
        for bias in self.biases:
            texture = CompressedTexture(self.layout, stored, bias)
            tried.append(TrainedState(name, texture, *loss_or_gain(self.base, self.footprint_errors(texture))))
        self.states.append(max(tried, key=lambda state: state.gain))
        self.begin.append(min(tried, key=lambda state: abs(state.texture.level_bias - self.trained_bias)))

    def add_ways(self) -> None:
        """Add states between the arrays before and after the training for appearance."""
        name, first, problem = self.in_progress
        for way in self.ways:
            self.add(f"{name} {way:.0%}", between(first, problem.net, way))
        self.in_progress = None

    def appearance_problem(self, texture: CompressedTexture) -> ShadingProblem:
        """Return the problem of training a texture for its appearance, with neutral extras if it is to have some."""
        recipe, layout, types = self.recipe, self.layout, self.pyramid.types
        net = CompressedTexture.from_table(to_table(texture, {}), types.TensorXf, "float32").net
        if recipe.extras and net.extras is None:
            net.extras = neutral_extras(layout.height, layout.width, net.border).alloc(types.TensorXf)
        changed = dataclasses.replace(recipe, level_bias=self.trained_bias)
        problem = ShadingProblem(net, self.pyramid, changed, self.source.digest, self.held_out, self.base)
        problem.preview = self.preview and (self.preview, self.evaluation)
        return problem


def between(first, second, share: float):
    """Return arrays that are a ``share`` of the way from ``first`` to ``second``, arrays of the same shapes."""
    others = iter(second.arrays.values())

    def mixed(array, bits):
        result = array.copy()
        result.data = dr.lerp(array.data, next(others).data, share)
        return result

    return first.changed(mixed)


def choose(states: list[TrainedState]) -> TrainedState:
    """Return the state with the largest gain: the first one, the start with a gain of 0, if none gains."""
    return max(states, key=lambda state: state.gain)
