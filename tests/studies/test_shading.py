"""``tradeoff shading``: what is trained and what it is compared with, trouble, sentences, what is written."""

import copy
import csv
import json

import numpy as np
import pytest

import mi_diffind
from mi_diffind.commands.cli import main
from mi_diffind.core.errors import UsageError
from mi_diffind.fitting import loop
from mi_diffind.studies.shading import conclusions, materials


def test_generated_materials():
    """They repeat, have unit normals and are what they are called."""
    for name in materials.MATERIALS:
        found = {m.name: m for m in materials.generated_source(name, 64).maps}
        normal = 2 * found["normal"].values - 1
        assert np.linalg.norm(normal, axis=-1) == pytest.approx(1, abs=0.02)
        assert found["albedo"].color_space == "srgb" and found["albedo"].values.std() > 0.02
        for axis in (0, 1):
            inside = np.abs(np.diff(normal, axis=axis)).mean()
            across = np.abs(np.take(normal, 0, axis) - np.take(normal, -1, axis)).mean()
            assert across < 1.5 * inside
        assert ("metallic" in found) == (name == "hammered")
    assert materials.generated_source("lacquer", 64).digest == materials.generated_source("lacquer", 64).digest
    assert {m.name: m.values.mean() for m in materials.generated_source("lacquer", 64).maps}["roughness"] < 0.35


def test_unknown_example():
    with pytest.raises(UsageError, match='found the material "gold", allowed are hammered, weave, lacquer'):
        mi_diffind.example_maps("gold")


def test_noise_has_the_spectrum_that_was_asked_for(rng):
    field = materials.noise(rng, 64, 1.0, 4, 16)
    power = np.abs(np.fft.fft2(field)) ** 2
    f = np.hypot(*np.meshgrid(*[np.fft.fftfreq(64) * 64] * 2))
    assert field.mean() == pytest.approx(0, abs=1e-9) and field.std() == pytest.approx(1)
    assert power[(f < 3.9) | (f > 16.1)].sum() < 1e-9 * power.sum()


def history(losses, values):
    return [{"step": i, "loss": loss, "shaded_converged_db": v} for i, (loss, v) in enumerate(zip(losses, values))]  # noqa: B905


@pytest.mark.parametrize(
    "changes, trouble",
    [
        ({}, []),
        ({"restarts": 2}, ["restarts"]),
        ({"history": history([1, 1, float("nan")], [20, 21, 22])}, ["nan"]),
        ({"history": history([1, 200, 1], [20, 21, 22])}, ["spike"]),
        ({"history": history([1, 1, 1], [20, 23, 22])}, ["drift"]),
        ({"C": {"mean_db": 19.0}}, ["below"]),
        ({"C": {"mean_db": float("nan")}}, ["nan"]),
        ({"history": []}, ["diverged"]),
    ],
)
def test_trouble(changes, trouble):
    from mi_diffind.studies.shading.plan import troubles

    run = {"history": history([2, 1, 1], [20, 21, 22]), "restarts": 0, "C": {"mean_db": 22.0}, **changes}
    assert troubles(run, {"C": {"mean_db": 20.0}}) == trouble


def measured(values, flip=0.1):
    return {"psnr_db": list(values), "mean_db": float(np.mean(values)), "coarse_db": float(np.mean(values[2:])),
            "flip": [flip]}  # fmt: skip


def run(way, share, seed, values, trouble=()):
    clip, schedule = ("no clip" not in way), ("no schedule" not in way)
    return {"material": "m", "kind": "run", "way": way, "share": share, "seed": seed, "clip": clip,
            "schedule": schedule, "C": measured(values), "P": measured([v + 1 for v in values]),
            "trouble": list(trouble)}  # fmt: skip


@pytest.fixture
def result():
    """A result as jobs leave it: two seeds, both remedies or none; numbers that can be followed by hand."""
    with_, without = conclusions.WITH, conclusions.WITHOUT
    details = [
        *({"material": "m", "kind": "classical", "label": label, "C": measured(v), "P": measured(v)} for label, v in {
            "filtered": [20, 20, 20, 20], "kernel": [21, 20, 20, 20], "LEAN": [22, 22, 22, 30],
            "Toksvig": [18, 18, 19, 19],
        }.items()),
        *(run(with_, 0.0, seed, [20, 20, 20, 20 + seed]) for seed in (0, 1)),
        *(run(without, 0.0, seed, [19, 19, 19, 19]) for seed in (0, 1)),
        *(run(with_, 0.9, seed, [21, 22, 24, 24 + seed]) for seed in (0, 1)),
        *(run(with_, 0.1, seed, [20.5, 20.5, 21, 21]) for seed in (0, 1)),
        *(run(without, 0.9, seed, [18, 18, 18, 18], ["restarts", "below"][: 2 - seed]) for seed in (0, 1)),
    ]  # fmt: skip
    return {"jobs": {str(i): {"bytes": 1000, "seconds": 1.0, "details": d} for i, d in enumerate(details)}}


def test_sentences(result):
    lines = conclusions.conclusions(result)
    text = "\n".join(lines)
    assert "m: the best lambda is 0.9, clip, schedule (22.88 dB, 22.75 to 23.00 dB over 2 seeds)" in text
    assert "over lambda = 0, against C +2.75 dB" in text
    assert "from level 2 on +4.00, the worst level +1.00" in text
    assert "in the paper's range of lambda, against C, +0.62 dB at 0.1" in text
    assert "the kernel alone, uncompressed, is worth +0.25 dB" in text
    assert (
        "uncompressed mip maps with LEAN wins against C (24.00 to 22.88 dB); it is ahead on level 0 (+1.00 dB)" in text
    )
    assert "lambda 0.9: both remedies gives +4.88 dB against C" in text
    last = f"{conclusions.WITHOUT}: of 2 runs with lambda > 0, 0 met a NaN, 0 were given up, 2 were restarted"
    assert lines[-1].startswith(last) and lines[-1].endswith("1 ended below lambda = 0")
    rows = conclusions.table(result)
    assert rows[0].startswith("m ") and any(r.endswith("restarts 2, below 1") for r in rows)


def test_sentences_of_what_there_is(result):
    """After an interruption anything may be missing."""
    jobs = list(result["jobs"].items())
    for n in range(len(jobs)):
        part = {**copy.deepcopy(result), "jobs": dict(jobs[:n])}
        conclusions.table(part)
        conclusions.conclusions(part)


def test_the_zoom_is_what_the_camera_sees(mi_rgb):
    """Pixels of a frame, against a ray of a pinhole camera above the plane; points stay where they are."""
    from mi_diffind.core.runtime import array_module
    from mi_diffind.maps.pyramid import Pyramid
    from mi_diffind.studies.shading import zoom
    from mi_diffind.tasks.shading.material import effects_of

    source = materials.generated_source("lacquer", 64)
    pyramid = Pyramid.of(source, types=array_module(mi_rgb.variant()))
    view = zoom.ShadedZoom(pyramid, effects_of(pyramid.layout)[0], 3, 8)
    spacings = [2 ** view.lanes(k)[2].numpy()[0] for k in range(3)]
    assert spacings == pytest.approx([zoom.FAR, np.sqrt(zoom.FAR * zoom.NEAR), zoom.NEAR], rel=1e-5)
    u, v, _, wi, wo = view.lanes(2)
    height = 4 * spacings[2] / np.tan(np.radians(zoom.FOV / 2))  # of the camera, in texels
    camera = np.array([32, 32, height])
    for pixel in (0, 7, 37, 63):
        way = np.array([wi.x.numpy()[pixel], wi.y.numpy()[pixel], wi.z.numpy()[pixel]])
        hit = camera - way * height / way[2]
        place = np.array([u.numpy()[pixel], v.numpy()[pixel]]) * 64
        assert (hit[:2] - place + 32) % 64 - 32 == pytest.approx(0, abs=1e-3)
    assert np.linalg.norm([c.numpy()[0] for c in wo]) == pytest.approx(1)
    frames = []
    for k in range(3):  # a pattern of the plane that is linear, which bilinear reads keep
        u, v = (np.arange(8) + 0.5 - 4) * spacings[k], (np.arange(8) + 0.5 - 4) * spacings[k]
        frames.append(np.stack(np.broadcast_arrays(u[None], v[:, None], 0.0), -1))
    aligned = view.aligned(np.stack(frames))
    inner = np.abs(aligned[2]).max(axis=-1) < 3.4 * zoom.NEAR
    np.testing.assert_allclose(aligned[0][inner], aligned[2][inner], atol=1e-3)


def test_seeds_of_the_sweep(mi_rgb):
    """Weights other than 0 and the preset's have fewer seeds; the paper's recipe has no filters beside it."""
    from mi_diffind.studies.shading import plan

    sources = {"lacquer": materials.generated_source("lacquer", 16)}
    for preset, last in (("ours", 0.9), ("paper", 0.25)):
        settings = plan.ShadingStudySettings((0.0, 0.25, 0.9), plan.REMEDIES[:1], 2, sweep_seeds=1, preset=preset)
        jobs = plan.plan(sources, settings).jobs
        runs = [(job.share, job.seed) for job in jobs if isinstance(job, plan.ShadingRun)]
        assert sorted(runs) == sorted([(0.0, 0), (0.0, 1), (0.25, 0), (0.9, 0), (last, 1)])
        assert any("Toksvig" in job.name for job in jobs) == (preset == "ours")


def test_extras_in_equal_bytes(mi_rgb, tmp_path, capsys):
    """Extras and the smaller arrays beside them take the bytes of the arrays alone, or a sentence says they cannot."""
    from mi_diffind.studies.shading import plan

    settings = plan.ShadingStudySettings(
        (0.0, 0.9), plan.REMEDIES[:1], 2, 0, 1, unit="steps", sweep_seeds=1, extras=True
    )
    jobs = plan.plan({"lacquer": materials.generated_source("lacquer", 64)}, settings).jobs
    (run,) = (job for job in jobs if job.method == "extras")
    assert run.start.extras and run.share == 0.9 and run.base.share == 0 and run.base.seed == run.seed == 0
    sizes = []
    for extras in (False, True):
        table, _ = run.context.fit_texture(run.context.pyramid, 1, 0, False, extras)
        sizes.append(table.nbytes)
    budget = run.context.source.nbytes / 12
    assert sizes[1] + 4 * 8 * 8 * 3 <= budget and sizes[0] <= budget and sizes[0] > sizes[1]
    small = plan.plan({"lacquer": materials.generated_source("lacquer", 16)}, settings).jobs[-1].context
    with pytest.raises(UsageError, match="--extras: found 149 bytes for all arrays, extras alone need"):
        small.fit_texture(small.pyramid, 1, 0, False, True)
    assert main(["tradeoff", "shading", "lacquer", "--preset", "paper", "--extras", "--out", str(tmp_path)]) == 2
    assert "--extras: the arrays of the preset paper have none" in capsys.readouterr().err


COMMAND = ["--quick", "--lambda", "1", "--remedies", "on", "--side", "16", "--frames", "2", "--steps", "2",
           "--pretrain-steps", "2"]  # fmt: skip


@pytest.mark.long
def test_what_is_written(tmp_path, monkeypatch, capsys):
    """A whole run, interrupted in the last training and continued: finished trainings are not repeated."""
    out = tmp_path / "out"
    command = ["tradeoff", "shading", "lacquer", *COMMAND, "--out", str(out), "--json", str(tmp_path / "r.json")]
    trained, take_step = [], loop._Trainer.take_step

    def counted(self, *args):
        trained.append(type(self.problem).__name__)
        if len(set(trained)) > 1 and self.problem.shading.share == 1:
            raise KeyboardInterrupt
        return take_step(self, *args)

    with monkeypatch.context() as m:
        m.setattr(loop._Trainer, "take_step", counted)
        assert main(command) == 130
    assert (out / "tradeoff_shading.partial.json").is_file() and set(trained) == {"TextureProblem", "ShadingProblem"}
    trained.clear()

    def again(self, *args):
        trained.append((type(self.problem).__name__, getattr(self.problem, "shading", None)))
        return take_step(self, *args)

    monkeypatch.setattr(loop._Trainer, "take_step", again)
    assert main(command) == 0
    assert {(name, shading.share) for name, shading in trained} == {("ShadingProblem", 1.0)}
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["resumed"] and not result["interrupted"]
    ways = ["lambda 0, clip, schedule", "lambda 1, clip, schedule"]
    names = [
        "filtered",
        "kernel",
        "Toksvig",
        "LEAN",
        "LEAN, kernel",
        "baked",
        "Toksvig, compressed",
        "kernel, compressed",
        *ways,
    ]
    assert list(result["candidates"]) == [f"lacquer, {name}" for name in names]
    for c in result["candidates"].values():
        e = c["errors"]
        assert {"c_mean_db", "p_mean_db", "c_coarse_db", "c_l0_db", "c_flip", "flicker", "flicker_error"} <= set(e)
        assert np.isfinite(list(e.values())).all() and 5 < e["c_mean_db"] < 60
    candidates = result["candidates"]
    assert candidates["lacquer, lambda 1, clip, schedule"]["bytes"] < candidates["lacquer, filtered"]["bytes"] / 6
    record = result["jobs"]["lacquer, lambda 1, clip, schedule, seed 0"]["details"]
    assert record["share"] == 1 and record["clip"] and record["restarts"] == 0 and len(record["C"]["psnr_db"]) == 3
    with open(out / "tradeoff_shading.csv", encoding="utf-8") as stream:
        rows = {r["candidate"]: r for r in csv.DictReader(stream)}
    assert float(rows["lacquer, LEAN"]["c_mean_db"]) == pytest.approx(
        candidates["lacquer, LEAN"]["errors"]["c_mean_db"], rel=1e-4
    )
    for kind in ("", "_levels", "_strip", "_zoom"):
        assert (out / f"tradeoff_shading{kind}.png").stat().st_size > 10_000
    assert not list(out.glob("*.partial*"))
    assert "uncompressed mip maps with LEAN" in capsys.readouterr().out


@pytest.mark.parametrize(
    "options, message",
    [
        (["--lambda", "1.5"], "1.5"),
        (["missing.json"], "missing.json"),
        (["granite"], "hammered, weave, lacquer"),
        (["lacquer", "lacquer"], "twice"),
        (["--compression", "0"], "0"),
        (["--steps", "3"], "--pretrain-steps"),
        (["lacquer", "weave", "--renders", "file.npz"], "--renders: found 2 materials, one is needed"),
        (["--steps", "3", "--pretrain-steps", "3", "--seconds", "1"], "beside seconds"),
    ],
)
def test_bad_options(tmp_path, options, message, capsys):
    with pytest.raises(SystemExit) if options[0] == "--lambda" else open("/dev/null") as _:
        assert main(["tradeoff", "shading", *options, "--quick", "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err


def test_equal_errors():
    """Four times the samples and the time have a quarter of the error, 6.02 dB; stratified ones an eighth."""
    from mi_diffind.studies.shading import renders

    def points(name, counts, slope):
        return [{"name": name, "spp": n, "psnr_db": 20 + slope * np.log10(n), "cpu_ms": {"median": 10.0 * n}}
                for n in counts]  # fmt: skip

    ours = [{"name": "ours", "spp": 1, "psnr_db": 20 + 10 * np.log10(8), "cpu_ms": {"median": 20.0}},
            {"name": "better", "spp": 1, "psnr_db": 50.0, "cpu_ms": {"median": 20.0}}]  # fmt: skip
    peers = points(renders.PEER, (1, 4, 16, 64), 10) + points(renders.MULTIJITTERED, (1, 4, 16, 64), 15)
    shares = renders.equal_errors(peers + ours)
    assert shares["ours"][renders.PEER] == pytest.approx({"share": 0.25, "spp": 8, "bound": False})
    assert shares["ours"][renders.MULTIJITTERED] == pytest.approx({"share": 0.5, "spp": 4, "bound": False})
    assert shares["better"][renders.PEER] == pytest.approx({"share": 1 / 32, "spp": 64, "bound": True})
