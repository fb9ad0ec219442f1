"""A task in one folder: a package of somebody else's, ``thirdparty/mi_profile``, adds a task, textures and a study by
entry points. Every command knows it, in processes in which it is installed, and nothing of this package names it.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10; pytest brings it
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(__file__).resolve().parent / "thirdparty" / "mi_profile"
DATA = PACKAGE / "mi_profile" / "data" / "downlight.csv"

#: Runs commands, and Python code, as they come: in one process, in which the package is installed.
COMMANDS = """
import contextlib, io, json, os, sys, traceback
from mi_diffind.commands.cli import main

def python(code, *arguments):
    sys.argv = ["-c", *arguments]
    try:
        exec(code, {"__name__": "code"})
    except Exception:
        traceback.print_exc()
        return 1
    return 0

for line in sys.stdin:
    request = json.loads(line)
    os.chdir(request["folder"])
    codes = []
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        for arguments in request["commands"]:
            try:
                codes.append(python(*arguments[1:]) if arguments[0] == "python" else main(arguments))
            except SystemExit as e:
                codes.append(e.code)
    print(json.dumps([codes, out.getvalue(), err.getvalue()]), flush=True)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder that makes the package an installed one: what pip would leave there of its ``pyproject.toml``."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    folder = tmp_path_factory.mktemp("site")
    information = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    information.mkdir()
    about = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (information / "METADATA").write_text(about)
    lines = [line for group, entries in project["entry-points"].items()
             for line in (f"[{group}]", *(f"{k} = {v}" for k, v in entries.items()))]  # fmt: skip
    (information / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def commands(site, tmp_path_factory):
    """A function that runs commands (``python``: code with arguments) and returns their codes and what they printed."""
    errors = tmp_path_factory.mktemp("errors") / "stderr.txt"
    paths = [str(site), str(PACKAGE), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": environ, "cwd": errors.parent}
    command = [sys.executable, "-c", COMMANDS]
    with open(errors, "w") as stderr, subprocess.Popen(command, stderr=stderr, **pipes) as process:

        def run(*commands, cwd):
            request = {"folder": str(cwd), "commands": [list(map(str, c)) for c in commands]}
            process.stdin.write(json.dumps(request) + "\n")
            process.stdin.flush()
            answer = process.stdout.readline()
            assert answer, errors.read_text()
            codes, out, err = json.loads(answer)
            assert "RuntimeWarning" not in err, err
            return codes, out, err

        yield run
        process.stdin.close()
    assert process.returncode == 0 and "RuntimeWarning" not in errors.read_text(), errors.read_text()


VARIANT = ("--variant", "llvm_ad_rgb")


@pytest.fixture(scope="module")
def fitted(commands, tmp_path_factory):
    """A folder with the trained tables, in bytes, and what was printed."""
    folder = tmp_path_factory.mktemp("fitted")
    fit = ("fit", "profile", DATA, "-o", "downlight.npz", "--storage", "float16", "--json", "fit.json", *VARIANT)
    codes, out, err = commands(fit, cwd=folder)
    assert codes == [0], err
    return folder, out


def test_nothing_of_ours_names_it():
    files = [p for folder in ("mi_diffind", "plugins", "docs") for p in (ROOT / folder).rglob("*.py")]
    assert files and not [p for p in files if "mi_profile" in p.read_text(encoding="utf-8")]


def test_the_data_are_those_of_the_script(commands, tmp_path):
    """A formula, so that nobody else's measurement is in the repository."""
    code = "from mi_profile import make_downlight as m; import pathlib; m.FILE = pathlib.Path('out.csv'); m.main()"
    assert commands(("python", code), cwd=tmp_path)[0] == [0]
    assert (tmp_path / "out.csv").read_text() == DATA.read_text()


def test_fit(fitted):
    folder, out = fitted
    report = json.loads((folder / "fit.json").read_text())
    assert "downlight.npz: 160 bytes as float16; best step " in out
    assert report["task"] == "profile" and report["preset"] == "default" and report["storage"] == "float16"
    assert report["measured"]["psnr_db"] > 45 and report["measured"]["largest_error_cd"] < 60
    assert report["settings"]["peak_cd"] == 1537.0


def test_inspect_and_decode(fitted, commands, tmp_path):
    folder, _ = fitted
    file = folder / "downlight.npz"
    codes, out, err = commands(
        ("inspect", file, "--measure", "--json", tmp_path / "r.json", *VARIANT),
        ("decode", file, "-o", "back.csv", "--samples", "181", *VARIANT),
        ("decode", file, "-o", "back.png", *VARIANT),
        ("decode", file, "-o", "back.csv", "--width", "5", *VARIANT),
        cwd=tmp_path,
    )  # fmt: skip
    assert codes == [0, 0, 2, 2], err
    assert 'tables for the task "profile", preset "default", 160 bytes as float16' in out and "peak 1,537.0 cd" in out
    found = json.loads((tmp_path / "r.json").read_text())
    assert found["peak_cd"] == 1537.0 and found["arrays"]["cascaded"]["resolution"] == [64]
    forms = found["measured_in_each_form"]
    assert set(forms) == {"float32", "float16", "uint8"} and forms["uint8"]["bytes"] == 80 and "as uint8: 80 b" in out
    assert forms["float16"]["psnr_db"] == pytest.approx(found["measured"]["psnr_db"], rel=1e-4)
    assert 'output "back.png": found the extension ".png", allowed is .csv' in err
    assert "--width does not apply to this file" in err
    truth, back = (np.loadtxt(p, delimiter=",", skiprows=n) for p, n in ((DATA, 2), (tmp_path / "back.csv", 1)))
    np.testing.assert_allclose(back[:, 0], truth[:, 0], atol=1e-4)
    mse = np.mean(((back[:, 1] - truth[:, 1]) / 1537) ** 2)
    assert -10 * np.log10(mse) == pytest.approx(found["measured"]["psnr_db"], abs=2)


def test_help(commands, tmp_path):
    codes, out, _ = commands(
        ("--help",), ("fit", "--help"), ("fit", "profile", "--help"), ("tradeoff", "--help"), ("decode", "--help"),
        cwd=tmp_path,
    )  # fmt: skip
    assert codes == [0] * 5
    text = " ".join(out.split())
    assert "profile train tables of a goniometric profile" in text and "()" not in text
    assert "PROFILE.csv" in text and "{default,small}" in text and "--samples N" in text
    assert "profile measure time against accuracy of all forms of a goniometric profile" in text


def test_what_it_refuses(commands, fitted, tmp_path):
    """Its own errors are caught like ours: one sentence, exit code 2."""
    (tmp_path / "odd.csv").write_text("angle_deg,intensity_cd\n0,1\n10,2\n90,0\n")
    fit = ("fit", "profile")
    codes, _, err = commands(
        (*fit, "odd.csv", "-o", "x.npz"), (*fit, "gone.csv", "-o", "x.npz"), (*fit, "-o", "x.npz"),
        ("tradeoff", "profile", "--source", "gone.csv"),
        cwd=tmp_path,
    )  # fmt: skip
    assert codes == [2] * 4
    assert "mi-diffind: error: odd.csv: the angles have to go from 0 to 90 in equal steps" in err
    assert "mi-diffind: error: gone.csv: cannot be read (No such file or directory)" in err
    assert "the following arguments are required: PROFILE.csv" in err and "Traceback" not in err
    assert sorted(os.listdir(tmp_path)) == ["odd.csv"]


SCENE = """<scene version="3.0.0"><integrator type="direct"/>
    <sensor type="perspective">
        <float name="fov" value="60"/>
        <transform name="to_world"><lookat origin="0, 0, 3" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="32"/><integer name="height" value="32"/><rfilter type="box"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
    </sensor>
    <shape type="rectangle"><transform name="to_world"><scale value="4"/></transform><bsdf type="diffuse"/></shape>
    <emitter type="projector">
        <float name="fov" value="100"/><float name="scale" value="20"/>
        <transform name="to_world"><lookat origin="0, 0, 1.5" target="0, 0, 0" up="0, 1, 0"/></transform>
        <texture name="irradiance" type="neural_profile" id="lamp"><float name="fov" value="100"/>
            <string name="filename" value="downlight.npz"/><string name="source" value="downlight.csv"/></texture>
    </emitter></scene>
"""


@pytest.fixture
def scene(fitted, tmp_path):
    """A scene that is lit by the learned profile, beside its tables and the measurement."""
    (tmp_path / "downlight.npz").write_bytes((fitted[0] / "downlight.npz").read_bytes())
    (tmp_path / "downlight.csv").write_bytes(DATA.read_bytes())
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


def test_compare_and_inspect_a_scene(commands, scene, tmp_path):
    """The learned texture against the measurement, which is put in its place; what the scene reads."""
    codes, out, err = commands(
        ("compare", scene, "--out", "out", "--passes", "2", "--json", "compare.json", *VARIANT),
        ("inspect", scene, "--json", "inspect.json", *VARIANT),
        cwd=tmp_path,
    )
    assert codes == [0, 0], err
    compared, inspected = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("compare", "inspect"))
    assert 30 < compared["psnr_db"] < 90 and compared["learned_plugins"] == 1
    assert compared["table_bytes"] == inspected["table_bytes"] == 160
    (said,) = inspected["learned_plugins"]
    assert (said["plugin"], said["id"], said["parameters"]["fov"]) == ("neural_profile", "lamp", 100)
    assert "1 learned plugin, 160 bytes" in out and "lamp" in out


TEXTURES = """
import sys
import mitsuba as mi, mi_diffind, drjit as dr, numpy as np
data = np.loadtxt(sys.argv[1] + "/downlight.csv", delimiter=",", skiprows=2)
for variant in ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_rgb"):
    mi.set_variant(variant)
    options = {"source": sys.argv[1] + "/downlight.csv", "fov": 80.0}
    exact = mi.load_dict({"type": "profile", **options})
    learned = mi.load_dict({"type": "neural_profile", "filename": sys.argv[1] + "/downlight.npz", **options})
    assert isinstance(learned, mi.Texture) and isinstance(learned, type(exact))
    si = dr.zeros(mi.SurfaceInteraction3f, 500)
    u = np.random.default_rng(0).random((2, 500), dtype=np.float32)
    si.uv = mi.Point2f(u)
    angle = np.degrees(np.arctan(2 * np.tan(np.radians(40)) * np.hypot(*(u.astype(np.float64) - 0.5))))
    expected = np.interp(angle, data[:, 0], data[:, 1]) / data[:, 1].max()
    np.testing.assert_allclose(exact.eval_1(si).numpy(), expected, atol=1e-5)
    assert np.sqrt(np.mean((learned.eval_1(si).numpy() - expected) ** 2)) < 0.01
    assert np.allclose(learned.eval(si).numpy()[0], learned.eval_1(si).numpy())
    assert learned.is_spatially_varying() and abs(float(learned.mean()[0]) - float(exact.mean()[0])) < 0.01
learned = mi.load_dict({"type": "neural_profile", "filename": sys.argv[1] + "/downlight.npz", "storage": "float32"})
params = mi.traverse(learned)
assert sorted(params.keys()) == ["tables.cascaded", "tables.primary"]
dr.enable_grad(params["tables.cascaded"])
dr.backward(dr.sum(learned.eval_1(si)))
assert dr.grad(params["tables.cascaded"]).numpy().sum() > 0
"""


def test_its_textures(commands, scene):
    """Executed afresh for each variant, one built upon the other; against the interpolation of NumPy."""
    codes, _, err = commands(("python", TEXTURES, scene.parent), cwd=scene.parent)
    assert codes == [0], err


def test_tradeoff(commands, tmp_path):
    codes, out, err = commands(
        ("tradeoff", "profile", "--quick", "--out", "out", "--json", "r.json", *VARIANT), cwd=tmp_path
    )
    assert codes == [0], err
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["task"] == "profile" and not result["interrupted"]
    candidates = {"measurement", *(f"{a}, {b}" for a in ("indirection", "single table")
                                   for b in ("float32", "float16", "uint8"))}  # fmt: skip
    assert set(result["candidates"]) == candidates
    assert result["candidates"]["indirection, uint8"]["errors"]["psnr_db"] > 15
    timings = result["cases"]["random angles"]["queries"]["read"]
    assert set(timings) == candidates and timings["indirection, float32"]["operations"]["gathers"] == 4
    assert sorted(p.name for p in (tmp_path / "out").glob("tradeoff_profile.*")) == [
        "tradeoff_profile.csv", "tradeoff_profile.json", "tradeoff_profile.png",
    ]  # fmt: skip
    assert "indirection, uint8" in out
