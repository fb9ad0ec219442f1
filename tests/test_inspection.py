"""``mi_diffind.inspect``: table files, and scenes in every form in which Python holds them."""

import json
from pathlib import Path

import pytest

import mi_diffind
from mi_diffind.commands.cli import main
from mi_diffind.core.errors import UsageError
from mi_diffind.core.units import figure_lines

ASSETS = Path(__file__).resolve().parents[1] / "scenes" / "assets"
SENSOR = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}


def texture(name, **more):
    return {"type": "neural_texture", "filename": str(ASSETS / "tiles_filtered.npz"), "channels": name, **more}


def scene():
    """Plugins of all kinds, learned and not, named and nested."""
    material = {"type": "principled", "base_color": texture("albedo"), "roughness": texture("roughness")}
    return {
        "type": "scene", "sensor": SENSOR, "integrator": {"type": "path_footprint", "max_depth": 3},
        "mat": {"type": "twosided", "nested": {"type": "normalmap", "normalmap": texture("normal"), "bsdf": material}},
        "ball": {"type": "sphere", "bsdf": {"type": "ref", "id": "mat"}},
        "plate": {"type": "rectangle", "bsdf": {"type": "disney", "roughness": 0.3, "base_color": {
            "type": "mipmap", "filename": str(ASSETS / "tiles_albedo.png")}}},
    }  # fmt: skip


def test_owners_are_the_paths_of_parameters(mi_rgb):
    """Each path that is reported begins a parameter of ``mi.traverse``, wherever the plugin is nested."""
    loaded = mi_diffind.load_dict(scene())
    reports = {r["owner"]: r for r in mi_diffind.inspect(loaded).figures["reports"]}
    assert {owner: report["plugin"] for owner, report in reports.items()} == {
        "integrator": "path_footprint",
        "mat.brdf_0.normalmap": "neural_texture",
        "mat.brdf_0.nested_bsdf.base_color": "neural_texture",
        "mat.brdf_0.nested_bsdf.roughness": "neural_texture",
        "plate.bsdf": "disney",
        "plate.bsdf.base_color": "mipmap",
    }
    keys = list(mi_rgb.traverse(loaded).keys())
    for owner in reports:
        assert owner == "integrator" or any(key.startswith(f"{owner}.") for key in keys), owner
    (report,) = mi_diffind.inspect(mi_rgb.load_dict({"type": "neural_disney"})).figures["reports"]
    assert report["owner"] == "(neural_disney)" and report["learned"] and report["effects_in_use"]
    assert {owner for owner, r in reports.items() if r["learned"]} == {o for o in reports if o.startswith("mat.")}


def test_lines_hide_internals(mi_rgb):
    inspection = mi_diffind.inspect(scene())
    short, long = "\n".join(inspection.lines()), "\n".join(inspection.lines(verbose=True))
    assert str(inspection) == short and inspection._repr_html_().startswith(
        "<pre>scene: 3 learned plugins and 3 others"
    )
    size = mi_diffind.open(ASSETS / "tiles_filtered.npz").nbytes
    assert inspection.figures["table_bytes"] == size  # of one file, which three textures read
    assert "mat.brdf_0.nested_bsdf.base_color: neural_texture, filename " in short and "flops" not in short
    assert "flops" in long and len(long) > len(short)
    assert inspection.figures["reports"][-2]["operations"]["eval"]["flops"] > 0


def test_a_file_and_its_scene_in_memory_agree(mi_rgb, tmp_path, capsys):
    """A file, the loaded scene and the command give equal reports; addresses do not show."""
    material = f"""<bsdf type="twosided"><bsdf type="diffuse" id="paint"><texture name="reflectance"
        type="neural_image"><string name="filename" value="{ASSETS / "tiles.npz"}"/>
        <string name="channels" value="albedo"/></texture></bsdf></bsdf>"""
    (tmp_path / "a.xml").write_text(f"""<scene version="3.0.0"><sensor type="perspective"/>
        <integrator type="path_footprint"/><shape type="cube">{material}</shape>
        <shape type="sphere"><bsdf type="neural_disney"/></shape></scene>""")
    path = str(tmp_path / "a.xml")
    of_file, of_scene = mi_diffind.inspect(path), mi_diffind.inspect(mi_diffind.load_file(path))
    of_file.figures["reports"].sort(key=str)  # Mitsuba loads in parallel, in any order
    of_scene.figures["reports"].sort(key=str)
    assert of_file.figures["reports"] == of_scene.figures["reports"]
    assert of_file.figures["table_bytes"] == of_scene.figures["table_bytes"]
    owners = [report["owner"] for report in of_file.figures["reports"]]
    assert owners == ["(Sphere).bsdf", "(path_footprint)", "paint.reflectance"]
    assert main(["inspect", path, "--json", str(tmp_path / "a.json"), "--variant", mi_rgb.variant()]) == 0
    assert sorted(capsys.readouterr().out.splitlines()) == sorted(of_file.lines())
    written = json.loads((tmp_path / "a.json").read_text())
    written["reports"].sort(key=lambda report: report["owner"])
    assert written == json.loads(json.dumps(of_file.figures))


def test_what_is_refused(mi_rgb):
    with pytest.raises(UsageError, match="--measure needs a table file"):
        mi_diffind.inspect(scene(), measure=True)
    with pytest.raises(UsageError, match="-D needs a scene file"):
        mi_diffind.inspect(scene(), defines={"a": 1})
    with pytest.raises(UsageError, match="inspect: found a int, allowed are"):
        mi_diffind.inspect(3)


def test_figures_for_people():
    figures = {"psnr_db": 27.176, "psnr_l0_db": 30, "psnr_l1_db": 31.5}
    figures |= {"normal_p95_deg": 6.1, "peak_error_0.1_0.5": 0.87}
    assert figure_lines(figures) == [
        "PSNR                   27.18 dB",
        "PSNR of levels         30.00, 31.50 dB",
        "normal p95             6.10°",
        "peak error 0.1 to 0.5  0.87",
    ]
    assert figure_lines({}) == []
