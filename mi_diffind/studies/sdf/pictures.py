"""Picture of the study of distance fields: errors of normals on the shape, errors against bytes and against time."""

from __future__ import annotations

import drjit as dr
import numpy as np

from ...measure import plot
from ...measure.curves import against_time, curves, finish
from ...measure.formatting import figure_caption
from ..equal_memory import candidates_by_budget
from .conclusions import size_text
from .contenders import DistanceContender, DistanceStudyContext
from .view import MeshView, traced_distance

#: Error of a normal, in degrees, at the end of the colour map.
WORST = 15.0

#: Method → colour, marker and line; lines of trained methods are dashed.
STYLES = {
    "dense": ("#4d4d4d", "s", ":"), "dense-trained": ("#4d4d4d", "s", "--"), "bricks8": ("#c47a00", "D", ":"),
    "bricks4": ("#762a83", "v", ":"), "bricks4-shared": ("#762a83", "^", "--"), "distances": ("#2166ac", "o", ":"),
    "distances-trained": ("#2166ac", "o", "--"), "ours": ("#b2182b", "o", "-"), "indirection": ("#1b7837", "P", ":"),
    "paper": ("#1b7837", "X", ":"), "hash": ("#12908e", "*", ":"),
}  # fmt: skip

#: Methods whose errors are shown on the shape, if they are part of the study.
SHOWN = ("dense-trained", "bricks4", "bricks4-shared", "distances", "ours")

#: Errors drawn against bytes: the error, its label, and whether one minus the error is drawn.
CURVES = (
    ("iou_near", "1 − IoU within 0.01 of the surface", True),
    ("normal_deg", "normals, mean error in degrees", False),
)


def shapes(context: DistanceStudyContext, jobs: dict[str, DistanceContender], view: MeshView, result: dict):
    """Draw the errors of contenders of the first budget (``jobs``), and of all budgets.

    Above, the angles between normals of the mesh and of the fields, where rays meet them; below, errors of all budgets
    against bytes, and errors of the first budget against the time of a ray.
    """
    first = result["details"]["first"]
    methods = {job.method: job for job in jobs.values()}
    shown = [methods[m] for m in SHOWN if m in methods]
    columns = max(3, len(shown) + 1)
    title = f"{result['title']}, {size_text(first)} above"
    figure = plot.figure(title, figure_caption(result), 2.6 * columns, 6.4)
    grid = figure.add_gridspec(2, 6 * columns, height_ratios=[1, 1.25])
    truth, hit = _mesh_normals(view)
    crop = plot.crop_to(hit)
    for k, job in enumerate([None, *shown]):
        axes = figure.add_subplot(grid[0, 6 * k : 6 * k + 6])
        if job is None:
            axes.imshow(_shaded(truth, hit)[crop])
            axes.set_title("mesh", fontsize=9)
        else:
            angles = _angles(context.types, view, job.model, truth, hit)
            drawn = axes.imshow(angles[crop], vmin=0, vmax=WORST, cmap="inferno_r")
            error = result["candidates"][job.name]["errors"]["normal_deg"]
            axes.set_title(f"{job.name.removesuffix(' ' + size_text(first))}\n{error:.2f}°", fontsize=8)
        axes.set_axis_off()
    if shown:
        bar = figure.colorbar(drawn, ax=figure.axes[1:], shrink=0.8, pad=0.01)
        bar.set_label("error of the normal, degrees", fontsize=8)
        bar.ax.tick_params(labelsize=7)
    third = 2 * columns
    for k, (key, label, missing) in enumerate(CURVES):
        _curves(figure.add_subplot(grid[1, third * k : third * (k + 1)]), result, key, label, missing)
    axes = figure.add_subplot(grid[1, 2 * third :])
    timings = result["cases"].get("rays", {}).get("queries", {}).get("ray", {})
    x_label = f"ns a primary ray, {size_text(first)}"
    labels = against_time(axes, result, timings, STYLES, "normal_deg", x_label, "normals, mean error in degrees")
    figure.get_layout_engine().set(hspace=0.16)
    plot.fix_layout(figure)
    handles, names = figure.axes[-3].get_legend_handles_labels()
    place = (0.5, axes.get_position().y1 + 0.01)  # two lines above the curves
    figure.legend(handles, names, loc="lower center", bbox_to_anchor=place, ncols=-(-len(names) // 2), fontsize=7.5,
                  frameon=False)  # fmt: skip
    plot.place_labels(axes, labels, [label.at for label in labels])
    return figure


def _mesh_normals(view: MeshView) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals of the mesh's triangles at all pixels ``(height, width, 3)``, and the mask of hits."""
    import mitsuba as mi

    o, d = view.rays(mi)
    scene, (width, height) = view.mesh_scene(), view.film
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
    hit = si.is_valid().numpy().reshape(height, width)
    return np.array(si.n).T.reshape(height, width, 3), hit


def _angles(types, view: MeshView, field, truth: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Return angles in degrees between normals; NaN where both are missed, 90 where one of them is."""
    o, d = view.rays(types)
    with dr.suspend_grad():
        t = traced_distance(field, o, d)
        field_hit = dr.isfinite(t)
        p = types.Array3f(dr.fma(d, dr.select(field_hit, t, 0), o))
        g = np.array(field.gradient(p)[1]).T.astype(np.float64)
    field_hit = field_hit.numpy()
    g /= np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-12)
    angles = np.degrees(np.arccos(np.clip(np.sum(g * truth.reshape(-1, 3), axis=1), -1, 1)))
    angles[field_hit != hit.ravel()] = 90
    angles[~field_hit & ~hit.ravel()] = np.nan
    return angles.reshape(hit.shape)


def _shaded(normals: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Return a picture of the mesh, lit from the upper left."""
    light = np.array([-0.4, 0.7, 0.6]) / np.linalg.norm([-0.4, 0.7, 0.6])
    grey = 0.25 + 0.65 * np.clip(normals @ light, 0, 1)
    return np.where(hit[..., None], grey[..., None] * np.array([1.0, 0.96, 0.9]), 1.0)


def _curves(axes, result: dict, key: str, label: str, missing: bool) -> None:
    """Draw an error against bytes, a line for each method."""
    candidates = [c for group in candidates_by_budget(result).values() for c in group.values()]
    curves(axes, candidates, STYLES, lambda c: (c["bytes"], 1 - c["errors"][key] if missing else c["errors"][key]))
    sizes = sorted({c["details"]["asked"] for c in candidates})
    axes.set_xscale("log", base=2)
    axes.set_xlim(sizes[0] / 1.3, sizes[-1] * 1.3)
    axes.set_xticks(sizes)
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    plot.log_ticks(axes.yaxis, low, high, lambda v: f"{v:.2g}")
    axes.xaxis.set_major_formatter(lambda value, _: size_text(round(value)))
    finish(axes, "memory", label)
