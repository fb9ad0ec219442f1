"""``mi-diffind inspect``: what is in a table file, or which learned plugins a scene uses."""

from __future__ import annotations

from pathlib import Path

from .. import runtime
from ..lookup import STORAGES, gathers
from ..tasks import ggx
from ..tasks.disney import arrays as disney_arrays
from ..tasks.disney.library import decoder_of, load_disney_table
from ..tasks.disney.training import measure
from ..tasks.image import compressed as image
from ..tasks.image.source import load_source
from .common import UsageError, defines_of, scene_options, set_variant, verb


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "inspect", run, "say what is in a table file, or which learned plugins a scene uses")
    sub.add_argument("file", metavar="FILE.npz|SCENE.xml")
    sub.add_argument("--measure", action="store_true", help="measure the accuracy of tables in each storage form")
    scene_options(sub, rendering=False)


def run(arguments) -> dict:
    """
    Print what the file holds and return it. Raises :class:`UsageError`, and
    :class:`~mi_diffind.tables.TableError` or :class:`~mi_diffind.scenes.SceneError` for a file that cannot be read.
    """
    if Path(arguments.file).suffix.lower() == ".xml":
        if arguments.measure:
            raise UsageError(f"{arguments.file}: --measure needs a table file (.npz)")
        return _inspect_scene(arguments)
    if arguments.variant or arguments.defines:
        raise UsageError(f"{arguments.file}: --variant and -D need a scene file (.xml)")
    from ..tables import load_table

    table = load_table(arguments.file)
    print(f'{arguments.file}: tables for the task "{table.task}", {table.nbytes:,} bytes as {table.storage}')
    arrays = {}
    for name, array in table.arrays.items():
        values = table.values(name)
        arrays[name] = {
            "resolution": list(array.shape[:-1]),
            "channels": array.shape[-1],
            "bytes": table.nbytes_of(name),
            "bits": table.bits.get(name, 8 * array.itemsize),
            "gathers_per_read": gathers(array.shape[:-1], array.shape[-1], table.storage, table.bits.get(name, 8)),
            "min": float(values.min()),
            "max": float(values.max()),
        }
        size = " x ".join(map(str, array.shape[:-1]))
        print(
            f"  {name:22} {size:>9}, {array.shape[-1]} channels, {table.nbytes_of(name):6,} bytes, "
            f"{arrays[name]['gathers_per_read']} gathers a read, "
            f"values {values.min():.4g} to {values.max():.4g}"
        )
    settings = {k: v for k, v in table.settings.items() if k != "layout"}
    about = _about_image(arguments.file, table) if table.task == image.TASK else {}
    for title, content in (
        ("trained with", {**settings, "seed": table.seed}),
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
        **about,
        **({"measured": measured} if measured else {}),
    }


def _about_image(file: str, table) -> dict:
    """Size, ratio and maps of a compressed image, printed and returned."""
    table, layout = image.load_image_table(file)
    ratio = layout.source_nbytes / table.nbytes if table.nbytes else None
    print(
        f"  {layout.width} x {layout.height}, {layout.stored} channel(s) stored of "
        f"{sum(m.channels for m in layout.maps)}, {layout.source_nbytes:,} bytes uncompressed: "
        + (f"{ratio:.2f}x" if ratio else "of one colour")
    )
    net = image.CompressedImage.from_table(table, runtime.array_module().TensorXf).net
    memory = sum(a.memory_nbytes for a in (*net.primary, net.cascaded)) if net else 0
    print(f"  {memory:,} bytes in memory")
    maps = {}
    for m in layout.maps:
        psnr = table.quality.get(f"psnr_{m.name}_db")
        stored = [w if isinstance(w, int) else "from x and y" if w == "z" else f"is {w[1]:.4g}" for w in m.where]
        maps[m.name] = {"channels": m.channels, "color_space": m.color_space, "stored_as": stored, "psnr_db": psnr}
        quality = f", {psnr:.2f} dB" if psnr is not None else ""
        kept = ", ".join(map(str, stored))
        print(f"    {m.name:20} {m.channels} channel(s), {m.color_space}, stored as {kept}{quality}")
    return {"width": layout.width, "height": layout.height, "source_bytes": layout.source_nbytes,
            "memory_bytes": memory, "compression": ratio, "maps": maps}  # fmt: skip


def _measure_image(file: str) -> dict:
    """Against the source, which has to be where it was."""
    table, _ = image.load_image_table(file)
    if "source_path" not in table.settings:
        raise UsageError(f"{file}: does not say which image it was made from, so it cannot be measured")
    path = Path(file).parent / str(table.settings["source_path"])
    source = load_source(path, nonfinite="clean")  # if it was not cleaned before either, the digest tells
    if source.digest != table.settings.get("source", source.digest):
        raise UsageError(f"{file}: its source {path} has changed since it was compressed")
    compressed = image.CompressedImage.from_table(table, runtime.array_module().TensorXf)
    found = compressed.measure(source)
    print("  against the source: " + ", ".join(f"{k} {v:.2f}" for k, v in found.items()))
    return found


def _measure(file: str, table) -> dict:
    """Accuracy of tables in each storage form, printed and returned."""
    measures = {disney_arrays.TASK: _measure_disney, ggx.TASK: _measure_ggx, image.TASK: _measure_image}
    if table.task not in measures:
        raise UsageError(f'{file}: holds tables for the task "{table.task}", which cannot be measured')
    return measures[table.task](file)


def _measure_disney(file: str) -> dict:
    """Over random directions and materials, for each distribution of the materials."""
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


def _measure_ggx(file: str) -> dict:
    """On the bounded range, and at the peak by bands of roughness."""
    (table, encoding), types, result = ggx.load_ggx_table(file), runtime.array_module(), {}
    for storage in STORAGES:
        net = ggx.to_indirection(table, types.TensorXf, storage)
        found = ggx.measure(ggx.LearnedGGX(net, encoding), types)
        memory = sum(array.memory_nbytes for array in (*net.primary, net.cascaded))
        result[storage] = {"bytes": net.nbytes, "memory_bytes": memory, **found}
        print(
            f"  {storage:8} {net.nbytes:6,} bytes ({memory:,} in memory): D clipped to [0, 1] "
            f"{found['psnr_db']:.2f} dB, mean absolute error {found['mae']:.2g}"
        )
        for low, high in ggx.BANDS:
            name = f"{low:g}_{high:g}"
            print(
                f"           roughness {low:g} to {high:g}: relative error at the normal at most "
                f"{found[f'peak_error_{name}']:.2%}, in the lobe {found[f'lobe_error_{name}']:.2%} (99th percentile)"
            )
    return result


def _inspect_scene(arguments) -> dict:
    set_variant(arguments.variant)
    from .. import scenes

    defines = defines_of(arguments)
    learned = scenes.learned_plugins(arguments.file, defines=defines)
    tables = scenes.tables_of(arguments.file, learned)
    reports = scenes.reports(scenes.load(arguments.file, defines=defines))
    total = sum(t.nbytes for t in tables.values())
    print(f"{arguments.file}: {len(learned)} learned plugin(s), {total:,} bytes of tables in {len(tables)} file(s)")
    for found in reports:
        given = {k: found[k] for k in ("filename", "channels") if k in found} | found["parameters"]
        given = (f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in given.items())
        stored = f", {found['table_bytes']:,} bytes as {found['storage']}" if found.get("storage") else ""
        print(f"  {found['id'] or '(no id)'}: {found['plugin']}, {', '.join(given) or 'defaults'}")
        print(f"    preset    {found.get('preset') or '(unknown)'}{stored}")
        print(f"    in use    {', '.join(found.get('effects_in_use', ())) or 'grazing reflection only'}")
        left_out = ", ".join(f"{k} ({v})" for k, v in found.get("effects_left_out", {}).items())
        print(f"    left out  {left_out or 'nothing'}")
        for method, n in found["operations"].items():
            print(
                f"    {method:9} {n['gathers']} reads of {n['bytes_gathered']} bytes, {n['flops']} flops "
                f"({n['add']} add, {n['mul']} mul, {n['div']} div, {n['sqrt']} sqrt), {n['instructions']} instructions"
            )
    return {
        "file": arguments.file,
        "learned_plugins": learned,
        "reports": reports,
        "table_bytes": total,
        "tables": [{"file": f, "storage": s, "bytes": t.nbytes} for (f, s), t in tables.items()],
    }
