"""
``mi-diffind``: render, compare, regress, inspect, fit, tradeoff.

Exit codes: 0 done, 1 a check failed, 2 bad usage or bad input, 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import sys
import time
from pathlib import Path

from . import __version__, runtime
from .files import OutputError, writable_file, writable_folder, write_json
from .fitting import SCHEDULES, FittingError
from .interrupt import interruptible
from .lookup import STORAGES, gathers
from .tables import TableError
from .tasks.disney.training import DEFAULT_SETTINGS


class UsageError(Exception):
    """Bad input that the argument parser cannot see."""


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    from .scenes import SceneError  # imports Mitsuba

    try:
        if arguments.json is not None:
            writable_file(arguments.json)
        result = arguments.run(arguments)
        if arguments.json is not None:
            write_json(arguments.json, result)
        return 130 if result.get("interrupted") else 1 if result.get("failed") else 0
    except (UsageError, OutputError, TableError, FittingError, SceneError) as e:
        print(f"mi-diffind: error: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("mi-diffind: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mi-diffind", description="Learned lookup tables for Mitsuba 3: differentiable indirection."
    )
    parser.add_argument("--version", action="version", version=f"mi-diffind {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run, help: str):
        sub = commands.add_parser(name, help=help, description=help)
        sub.set_defaults(run=run)
        sub.add_argument("--json", metavar="FILE", help="also write what is printed to FILE")
        return sub

    def scene_options(sub, rendering: bool = True):
        sub.add_argument("--variant", help="Mitsuba variant (default: cuda_ad_rgb with a GPU, else llvm_ad_rgb)")
        sub.add_argument(
            "-D",
            dest="defines",
            action="append",
            default=[],
            metavar="NAME=VALUE",
            help="set a <default> of the scene",
        )
        if rendering:
            sub.add_argument("--spp", type=_positive, help="samples per pixel (default: the scene's)")
            sub.add_argument("--seed", type=_natural, default=0, help="seed of the random numbers (default: 0)")

    sub = command("render", _render, "render a scene that names learned plugins")
    sub.add_argument("scene", metavar="SCENE.xml")
    sub.add_argument("-o", "--output", metavar="FILE", help="image, .exr or .png (default: SCENE.exr)")
    sub.add_argument(
        "--depth",
        type=_depth,
        default="scene",
        metavar="auto|N|scene",
        help="longest path, counted as max_depth: the scene's (default), N, or measured: where a probe finds the rest "
        "below a tolerance",
    )
    sub.add_argument(
        "--depth-tolerance",
        type=_fraction,
        metavar="T",
        help="part of the scattered light that --depth auto may leave out (default: 0.005)",
    )
    scene_options(sub)

    sub = command("compare", _compare, "render a scene as written and with exact plugins, and show the difference")
    sub.add_argument("scene", metavar="SCENE.xml")
    sub.add_argument("--out", default="out", metavar="DIR", help="folder for pictures (default: out)")
    sub.add_argument("--passes", type=_positive, default=5, help="passes to split the samples into (default: 5)")
    scene_options(sub)

    sub = command("regress", _regress, "check that scenes render as their stored references do")
    sub.add_argument("scenes", nargs="+", metavar="SCENE.xml")
    sub.add_argument("--update", action="store_true", help="render the references again and store them")
    sub.add_argument(
        "--references", metavar="DIR", help='folder of the references (default: "references" by the scene)'
    )
    sub.add_argument("--out", default="out", metavar="DIR", help="folder for what a failed check saw (default: out)")
    sub.add_argument("--spp", type=_positive, help="samples per pixel of a check (default: the reference's)")
    sub.add_argument("--seed", type=_natural, help="seed of the random numbers (default: 0; --update: the reference's)")
    scene_options(sub, rendering=False)

    sub = command("inspect", _inspect, "say what is in a table file, or which learned plugins a scene uses")
    sub.add_argument("file", metavar="FILE.npz|SCENE.xml")
    sub.add_argument("--measure", action="store_true", help="measure the accuracy of tables in each storage form")
    scene_options(sub, rendering=False)

    sub = command("tradeoff", _tradeoff, "measure time against accuracy of all forms of a task")
    sub.add_argument("task", choices=["disney"])
    sub.add_argument("--out", default="out", metavar="DIR", help="folder for table and plot (default: out)")
    sub.add_argument("--quick", action="store_true", help="smoke run: less of everything, times not to be quoted")
    sub.add_argument("--variant", help="Mitsuba variant (default: cuda_ad_rgb with a GPU, else llvm_ad_rgb)")

    sub = command("encode", _encode, "turn the parameter textures of a material into latent textures")
    sub.add_argument("scene", metavar="SCENE.xml")
    sub.add_argument("--material", required=True, metavar="ID", help="id of the material")
    sub.add_argument("-o", "--output", required=True, metavar="DIR", help="folder for textures and material.xml")
    sub.add_argument(
        "--storage", choices=["uint8", "float16"], default="uint8", help="PNG or EXR (default: uint8, PNG)"
    )
    sub.add_argument("--resolution", type=_positive, help="side in texels (default: that of the largest texture)")
    scene_options(sub, rendering=False)

    sub = command("fit", _fit, "train tables")
    sub.add_argument("task", choices=["disney"])
    sub.add_argument("-o", "--output", required=True, metavar="FILE.npz", help="table file to write")
    sub.add_argument("--quality", choices=["tables", "paper"], default="tables", help="layout (default: tables)")
    sub.add_argument("--storage", choices=STORAGES, default="float32", help="storage form (default: float32)")
    sub.add_argument("--backend", choices=["llvm", "cuda"], help="where to train (default: the GPU if there is one)")
    default = DEFAULT_SETTINGS["tables"]
    sub.add_argument("--steps", type=_positive, help=f"optimisation steps (default: {default.steps})")
    sub.add_argument("--batch", type=_positive, help=f"samples a step (default: {default.batch})")
    sub.add_argument("--lr", type=float, help="Adam's learning rate (default: the task's)")
    sub.add_argument("--schedule", choices=SCHEDULES, help=f"of the learning rate (default: {default.schedule})")
    sub.add_argument("--seed", type=_natural, help=f"seed of the random numbers (default: {default.seed})")
    sub.add_argument("--all-cores", action="store_true", help="faster, but not the same bytes each time")
    sub.add_argument("--checkpoint", metavar="FILE", help="keep the state of the training in FILE")
    sub.add_argument("--resume", action="store_true", help="go on from --checkpoint, with the same settings")
    return parser


def _positive(text: str) -> int:
    value = _natural(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _natural(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number ≥ 0")
    return value


def _depth(text: str) -> int | str:
    if text in ("auto", "scene"):
        return text
    try:
        return _positive(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"found {text}, allowed are auto, scene and whole numbers ≥ 1") from None


def _fraction(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"found {text}, allowed is more than 0 and less than 1")
    return value


def _set_variant(name: str | None) -> None:
    import drjit as dr
    import mitsuba as mi

    if name is None:
        name = "cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb"
    if name not in mi.variants():
        raise UsageError(f'the variant "{name}" does not exist; available are {", ".join(mi.variants())}')
    if name.startswith("llvm") and runtime.llvm_problem():
        raise UsageError(runtime.llvm_problem())
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise UsageError(f'the variant "{name}" needs an NVIDIA GPU and its driver, and none was found')
    try:
        mi.set_variant(name)
    except ImportError as e:
        raise UsageError(f'the variant "{name}" cannot run here: {e}') from None
    mi.set_log_level(mi.LogLevel.Error)


def _defines(arguments) -> dict[str, str]:
    result = {}
    for text in arguments.defines:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise UsageError(f'-D {text}: expected NAME=VALUE, as in "-D width=320"')
        result[name] = value
    return result


def _require_scene(path: str) -> None:
    """Before an output folder is made."""
    if not Path(path).is_file():
        raise UsageError(f"{path}: no such scene file")


def _render(arguments) -> dict:
    from tqdm import tqdm

    _require_scene(arguments.scene)
    output = Path(arguments.output or Path(arguments.scene).with_suffix(".exr").name)
    if output.suffix.lower() not in (".exr", ".png"):
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are .exr and .png')
    if arguments.depth_tolerance is not None and arguments.depth != "auto":
        raise UsageError("--depth-tolerance needs --depth auto")
    writable_file(output)
    _set_variant(arguments.variant)
    import mitsuba as mi

    from . import scenes

    defines = _defines(arguments)
    depth = _choose_depth(arguments, defines)
    start = time.perf_counter()
    learned = scenes.learned_plugins(arguments.scene, defines=defines)
    changed = depth["chosen"] != depth["scene"]
    scene = scenes.load(arguments.scene, longest_path=depth["chosen"] if changed else None, defines=defines)
    loaded = time.perf_counter()
    spp = arguments.spp or scene.sensors()[0].sampler().sample_count()
    passes = max(1, spp // 16)
    with interruptible() as stop, tqdm(total=passes, desc="render", unit="pass", disable=None) as bar:
        image, seconds = scenes.render(scene, spp, arguments.seed, passes, bar.update, stop)
    rendered = time.perf_counter()
    scenes.write_image(output, image)
    done = len(seconds) * spp // passes
    kept = f"interrupted, kept {done} of {spp}" if done < spp else f"{spp}"
    size = f"{image.shape[1]} x {image.shape[0]}"
    print(f"{output}: {size}, {kept} spp, {rendered - loaded:.1f} s in {mi.variant()}")
    return {
        "interrupted": done < spp,
        "scene": arguments.scene,
        "output": str(output),
        "variant": mi.variant(),
        "width": image.shape[1],
        "height": image.shape[0],
        "spp": done,
        "seed": arguments.seed,
        "depth": depth,
        "seconds_load": loaded - start,
        "seconds_render": rendered - loaded,
        "learned_plugins": learned,
        "learned_materials": scenes.reports(scene) if arguments.json is not None else [],
        "table_bytes": scenes.table_bytes(arguments.scene, learned),
    }


def _choose_depth(arguments, defines: dict[str, str]) -> dict:
    """The depth to render to, and why; what was not measured is None."""
    from . import scenes, transport

    if arguments.depth == "auto":
        tolerance = arguments.depth_tolerance or transport.TOLERANCE
        found = transport.auto_depth(arguments.scene, tolerance, arguments.seed, defines=defines)
        print("\n".join(transport.summary(found)))
        return {"requested": "auto", **found}
    own = None
    with contextlib.suppress(scenes.SceneError):  # no integrator with a depth: fine, unless one is asked for
        own = scenes.integrator_of(arguments.scene, defines=defines)[1]
    chosen = own if arguments.depth == "scene" else arguments.depth
    unknown = ("tolerance", "shares", "left_out", "left_out_in_a_tile", "probe_seconds")
    return {"requested": arguments.depth, "chosen": chosen, "scene": own, **dict.fromkeys(unknown)}


def _compare(arguments) -> dict:
    _require_scene(arguments.scene)
    writable_folder(arguments.out, create=True)
    _set_variant(arguments.variant)
    from . import compare

    comparison = compare.compare(
        arguments.scene, arguments.spp, arguments.seed, arguments.passes, defines=_defines(arguments)
    )
    paths = compare.write(comparison, arguments.out)
    print("\n".join(compare.summary(comparison.figures)))
    print(f"picture     {paths['figure']}")
    return {**comparison.figures, "files": paths}


def _regress(arguments) -> dict:
    for path in arguments.scenes:
        _require_scene(path)
    stems = [Path(path).stem for path in arguments.scenes]
    for stem in stems:
        if stems.count(stem) > 1:
            raise UsageError(f'{len(stems)} scenes, and more than one is called "{stem}": check them one at a time')
    _set_variant(arguments.variant)
    from . import regress

    defines, results = _defines(arguments), []
    options = {"spp": arguments.spp, "seed": arguments.seed, "defines": defines}
    if arguments.update:
        for path in arguments.scenes:
            results.append(regress.update_reference(path, arguments.references, **options))
            if results[-1]["interrupted"]:
                break
            text = "{reference}: {width} x {height}, {spp} spp, {bytes:,} bytes; "
            text += "failing pixels in a check at {budget} spp: {failing_pixels}"
            print(text.format(**results[-1]))
    else:
        out = Path(arguments.out)
        writable_folder(out if out.exists() else out.parent)
        options["seed"] = arguments.seed or 0
        for path in arguments.scenes:  # before the first is rendered
            regress.read_reference(path, arguments.references)
        try:
            for path in arguments.scenes:
                results.append(regress.regress(path, arguments.references, out, **options))
                if results[-1]["interrupted"]:
                    break
        finally:
            if results:
                print("\n".join(regress.summary(results)))
    return {
        "interrupted": results[-1]["interrupted"],
        "failed": sum(r.get("passed") is False for r in results),
        "scenes": results,
    }


def _inspect(arguments) -> dict:
    if Path(arguments.file).suffix.lower() == ".xml":
        if arguments.measure:
            raise UsageError(f"{arguments.file}: --measure needs a table file (.npz)")
        return _inspect_scene(arguments)
    if arguments.variant or arguments.defines:
        raise UsageError(f"{arguments.file}: --variant and -D need a scene file (.xml)")
    from .tables import load_table

    table = load_table(arguments.file)
    print(f'{arguments.file}: tables for the task "{table.task}", {table.nbytes:,} bytes as {table.storage}')
    arrays = {}
    for name, array in table.arrays.items():
        values = table.values(name)
        arrays[name] = {
            "resolution": list(array.shape[:-1]),
            "channels": array.shape[-1],
            "bytes": array.nbytes,
            "gathers_per_read": gathers(array.shape[:-1], array.shape[-1], table.storage),
            "min": float(values.min()),
            "max": float(values.max()),
        }
        size = " x ".join(map(str, array.shape[:-1]))
        print(
            f"  {name:22} {size:>9}, {array.shape[-1]} channels, {array.nbytes:6,} bytes, "
            f"{arrays[name]['gathers_per_read']} gathers a read, "
            f"values {values.min():.4g} to {values.max():.4g}"
        )
    for title, content in (
        ("trained with", {**table.settings, "seed": table.seed}),
        ("measured", table.quality),
    ):
        print(f"  {title}: " + ", ".join(f"{k} {v}" for k, v in content.items()))
    measured = _measure(arguments.file, table) if arguments.measure else None
    return {
        "file": arguments.file,
        "task": table.task,
        "storage": table.storage,
        "bytes": table.nbytes,
        "arrays": arrays,
        "settings": table.settings,
        "seed": table.seed,
        "quality": table.quality,
        **({"measured": measured} if measured else {}),
    }


def _measure(file: str, table) -> dict:
    """Accuracy over random directions and materials, for each storage form and distribution of the materials."""
    from .tasks.disney.arrays import TASK
    from .tasks.disney.library import decoder_of, load_disney_table
    from .tasks.disney.training import measure

    if table.task != TASK:
        raise UsageError(f'{file}: holds tables for the task "{table.task}", which cannot be measured')
    (table, layout), types, result = load_disney_table(file), runtime.array_module(), {}
    for storage in STORAGES:
        form = table.to(storage)
        net = layout.from_table(table, types.TensorXf, storage)
        result[storage] = {"bytes": form.nbytes, "memory_bytes": net.memory_nbytes}
        for distribution in ("training", "uniform"):
            result[storage][distribution] = found = measure(decoder_of(net), types, distribution=distribution)
            print(
                f"  {storage:8} {form.nbytes:6,} bytes ({net.memory_nbytes:,} in memory), {distribution:8} materials: "
                f"BRDF x cosine {found['psnr_db']:.2f} dB, BRDF {found['psnr_brdf_db']:.2f} dB"
            )
    return result


def _inspect_scene(arguments) -> dict:
    _set_variant(arguments.variant)
    from . import scenes

    defines = _defines(arguments)
    learned = scenes.learned_plugins(arguments.file, defines=defines)
    tables = scenes.tables_of(arguments.file, learned)
    materials = scenes.reports(scenes.load(arguments.file, defines=defines))
    total = sum(t.nbytes for t in tables.values())
    print(f"{arguments.file}: {len(learned)} learned material(s), {total:,} bytes of tables in {len(tables)} file(s)")
    given = {entry["id"]: entry["parameters"] for entry in learned}
    for material in materials:
        parameters = given.get(material["id"]) or {}
        parameters = ", ".join(f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in parameters.items())
        stored = f", {material['table_bytes']:,} bytes as {material['storage']}" if material["storage"] else ""
        print(f"  {material['id'] or '(no id)'}: {parameters or 'defaults'}")
        print(f"    quality   {material['quality']}{stored}")
        print(f"    in use    {', '.join(material['effects_in_use']) or 'grazing reflection only'}")
        left_out = ", ".join(f"{k} ({v})" for k, v in material["effects_left_out"].items())
        print(f"    left out  {left_out or 'nothing'}")
        for method, n in material["operations"].items():
            print(
                f"    {method:9} {n['gathers']} reads of {n['bytes_gathered']} bytes, {n['flops']} flops "
                f"({n['add']} add, {n['mul']} mul, {n['div']} div, {n['sqrt']} sqrt), {n['instructions']} instructions"
            )
    return {
        "file": arguments.file,
        "learned_plugins": learned,
        "learned_materials": materials,
        "table_bytes": total,
        "tables": [{"file": f, "storage": s, "bytes": t.nbytes} for (f, s), t in tables.items()],
    }


def _tradeoff(arguments) -> dict:
    writable_folder(arguments.out, create=True)
    _set_variant(arguments.variant)
    import importlib

    import mitsuba as mi

    from . import plugins, tradeoff

    if not plugins.supported(mi.variant()):
        usable = ", ".join(v for v in mi.variants() if plugins.supported(v))
        raise UsageError(f'the plugins do not run in the variant "{mi.variant()}"; use one of {usable}')
    study = importlib.import_module(f".tradeoffs.{arguments.task}", __package__).study(arguments.quick)
    result = tradeoff.measure(study, tradeoff.Settings.choose(mi.variant(), arguments.quick), arguments.out)
    paths = tradeoff.write(result, arguments.out)
    print("\n".join(tradeoff.summary(result)))
    print("\nwritten     " + ", ".join(paths.values()))
    return {**tradeoff.finite(result), "files": paths}


def _encode(arguments) -> dict:
    _require_scene(arguments.scene)
    writable_folder(Path(arguments.output).parent)
    _set_variant(arguments.variant)
    from .encode import encode

    found = encode(
        arguments.scene,
        arguments.material,
        arguments.output,
        arguments.storage,
        arguments.resolution,
        _defines(arguments),
    )
    layout = [found["layout"][i : i + 3] for i in range(0, len(found["layout"]), 3)]
    print(f"{found['files'][0]}: {found['width']} x {found['height']}, quality {found['quality']}")
    for i, names in enumerate(layout):
        print(f"  latents_{i}   {', '.join(names)}")
    if found["base_color"]:
        print("  base_color  albedo")
    ratio = found["time_ratio"]
    print(
        f"  {found['bytes']:,} bytes ({found['bytes_before']:,} before), PSNR {found['psnr_db']:.2f} dB, "
        f"time of an eval {ratio['median']:.2f} of that before ({ratio['q1']:.2f} to {ratio['q3']:.2f})"
    )
    return found


def _fit(arguments) -> dict:
    output = Path(arguments.output)
    if output.suffix.lower() != ".npz":
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed is .npz')
    if arguments.checkpoint is not None and Path(arguments.checkpoint).resolve() == output.resolve():
        raise UsageError(f'"{output}" cannot be the output and the checkpoint')
    writable_file(output)
    from .tables import save_table
    from .tasks.disney.training import fit_disney

    given = {k: getattr(arguments, k) for k in ("steps", "batch", "lr", "schedule", "seed")}
    given = {k: v for k, v in given.items() if v is not None}
    settings = dataclasses.replace(DEFAULT_SETTINGS[arguments.quality], deterministic=not arguments.all_cores, **given)
    try:
        table, result = fit_disney(
            settings,
            arguments.backend,
            arguments.quality,
            arguments.storage,
            arguments.checkpoint,
            arguments.resume,
        )
    except RuntimeError as e:
        raise FittingError(str(e)) from e
    save_table(output, table)
    quality = ", ".join(f"{k} {v}" for k, v in table.quality.items())
    state = f"interrupted at step {result.steps}, kept" if result.interrupted else "best"
    print(f"{output}: {table.nbytes:,} bytes as {table.storage}; {state} step {result.step}; {quality}")
    return {
        "interrupted": result.interrupted,
        "output": str(output),
        "bytes": table.nbytes,
        "storage": table.storage,
        "settings": table.settings,
        "quality": table.quality,
        "step": result.step,
        "seconds": result.seconds,
        "restarts": result.restarts,
        "history": result.history,
    }


if __name__ == "__main__":
    sys.exit(main())
