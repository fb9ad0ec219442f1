"""Conclusions of the shading study: a table, gains over λ = 0 and over classical filters, effects of the remedies.

All figures come from the records of jobs, so an interrupted run reports the finished ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...measure.formatting import enumeration, grid

#: Names of the runs with both remedies, and with none.
WITH, WITHOUT = "clip, schedule", "no clip, no schedule"

#: Classical filters and the kernel control; filters combined with that kernel.
PLAIN = ("Toksvig", "LEAN", "baked", "kernel")
COMBINED = ("LEAN, kernel", "baked, kernel")

#: First coarse level of detail.
COARSE = 2


@dataclass
class MaterialCurves:
    """Records of a material: ``classical``, ``compressed``, ``extras`` (by label), ``runs`` (by remedies and λ).

    ``runs`` has the details of all seeds; those of λ = 0 stand under all remedies that they are the base of.
    """

    name: str
    classical: dict[str, dict] = field(default_factory=dict)
    compressed: dict[str, dict] = field(default_factory=dict)
    extras: dict[str, dict] = field(default_factory=dict)
    runs: dict[tuple[str, float], list[dict]] = field(default_factory=dict)

    @property
    def remedies(self) -> list[str]:
        return list(dict.fromkeys(remedy for remedy, share in self.runs if share > 0))

    @property
    def filters(self) -> dict[str, dict]:
        """Label → details of the classical filters, without the filtered parameters."""
        return {label: self.classical[label] for label in (*PLAIN, *COMBINED) if label in self.classical}

    def shares(self, remedy: str) -> list[float]:
        return sorted(share for r, share in self.runs if r == remedy)

    def values(self, remedy: str, share: float, letter: str = "C", key: str = "mean_db") -> list[float]:
        """Return ``mean_db``, ``coarse_db`` or ``flip`` of each seed."""
        errors = [d[letter] for d in self.runs.get((remedy, share), [])]
        return [float(np.mean(e["flip"])) if key == "flip" else e[key] for e in errors if e.get(key)]

    def mean(self, *key) -> float:
        values = self.values(*key)
        return float(np.mean(values)) if values else float("nan")

    def levels(self, remedy: str, share: float, letter: str = "C") -> np.ndarray:
        """Return the PSNR of each level, averaged over seeds."""
        return np.mean([d[letter]["psnr_db"] for d in self.runs[remedy, share]], axis=0)

    def best(self) -> tuple[str, float] | None:
        """Return the remedies and λ > 0 with the best mean against C, of those with a run of λ = 0, or ``None``."""
        keys = [(remedy, s) for remedy, s in self.runs if s > 0 and (remedy, 0.0) in self.runs]
        return max(keys, key=lambda key: self.mean(*key), default=None)

    @property
    def best_classical(self) -> str | None:
        """The best classical filter against C, uncompressed."""
        return max(self.filters, key=lambda label: self.classical[label]["C"]["mean_db"], default=None)


def curves(result: dict) -> dict[str, MaterialCurves]:
    """Return the records of all materials with any measurement, by name."""
    materials: dict[str, MaterialCurves] = {}
    for record in result["jobs"].values():
        d = record.get("details", {})
        if "material" not in d:
            continue
        material = materials.setdefault(d["material"], MaterialCurves(d["material"]))
        if d["kind"] in ("classical", "compressed", "extras"):
            getattr(material, d["kind"])[d["label"]] = d
        elif d["kind"] == "run":
            material.runs.setdefault((d["way"], d["share"]), []).append(d)
    for material in materials.values():
        bases = {d["schedule"]: remedy for (remedy, share), ds in material.runs.items() if share == 0 for d in ds}
        for remedy in material.remedies:
            schedule = next(ds[0]["schedule"] for (r, s), ds in material.runs.items() if r == remedy and s > 0)
            if schedule in bases:
                material.runs[remedy, 0.0] = material.runs[bases[schedule], 0.0]
    return materials


def table(result: dict) -> list[str]:
    """Return, for each material, a table of errors against both truths; errors of levels are those against C."""
    lines = []
    for material in curves(result).values():
        records = [r for r in result["jobs"].values() if r["details"].get("material") == material.name]
        nbytes = {r["details"]["label"]: r["bytes"] for r in records if r["details"].get("label")}
        run_bytes = next((r["bytes"] for r in records if r["details"]["kind"] == "run"), 0)
        levels = len(next(iter(material.classical.values()))["C"]["psnr_db"]) if material.classical else 0
        cells = [[material.name, "bytes", "C", "low", "high", "coarse", "FLIP", *(f"L{i}" for i in range(levels)), "P",
                  "coarse", "FLIP", "trouble"]]  # fmt: skip
        for label, d in material.classical.items():
            cells.append([f"{label}, uncompressed", f"{nbytes[label]:,}", *_error_cells([d], levels), ""])
        for label, d in {**material.compressed, **material.extras}.items():
            cells.append([label, f"{nbytes[label]:,}", *_error_cells([d], levels), ""])
        for remedy in material.remedies or dict.fromkeys(remedy for remedy, _ in material.runs):
            for share in material.shares(remedy):
                runs = material.runs[remedy, share]
                cells.append([f"lambda {share:g}, {remedy}", f"{run_bytes:,}", *_error_cells(runs, levels),
                              trouble(runs)])  # fmt: skip
        lines += ["", *grid(cells, "")]
    return lines[1:]


def _error_cells(runs: list[dict], levels: int) -> list[str]:
    def mean(letter: str, key: str, digits: int) -> str:
        values = [np.mean(d[letter][key]) for d in runs if d[letter][key]]
        return f"{np.mean(values):.{digits}f}" if values else "-"

    c = [d["C"]["mean_db"] for d in runs]
    by_level = [f"{np.mean([d['C']['psnr_db'][i] for d in runs]):.1f}" for i in range(levels)]
    return [f"{np.mean(c):.2f}", f"{min(c):.2f}", f"{max(c):.2f}", mean("C", "coarse_db", 2), mean("C", "flip", 4),
            *by_level, mean("P", "mean_db", 2), mean("P", "coarse_db", 2), mean("P", "flip", 4)]  # fmt: skip


def trouble(runs: list[dict]) -> str:
    """Return the names of troubles, each with the number of runs."""
    names = [name for d in runs for name in d.get("trouble", [])]
    return ", ".join(f"{name} {names.count(name)}" for name in dict.fromkeys(names))


def conclusions(result: dict) -> list[str]:
    """Return lines about gains over λ = 0 and over classical filters, effects of the remedies, and troubles."""
    materials, lines = curves(result).values(), []
    for material in materials:
        lines += _gains(material) + _against_classical(material) + _effects_of_remedies(material)
    runs: dict[str, list[dict]] = {}
    for material in materials:
        for (remedy, share), details in material.runs.items():
            if share > 0:
                runs.setdefault(remedy, []).extend(details)
    for remedy, details in runs.items():
        counts = [f"{sum(name in d['trouble'] for d in details)} {phrase}" for name, phrase in _PHRASES.items()]
        lines.append(f"{remedy}: of {len(details)} runs with lambda > 0, {enumeration(counts)}")
    return lines


#: Trouble → its phrase in a sentence about a number of runs.
_PHRASES = {
    "nan": "met a NaN",
    "diverged": "were given up",
    "restarts": "were restarted",
    "spike": "had a loss above ten times its median",
    "drift": "ended below their best state",
    "below": "ended below lambda = 0",
}


def _gains(material: MaterialCurves) -> list[str]:
    """Compare the best λ with λ = 0."""
    best = material.best()
    if best is None:
        return []
    remedy, share = best
    parts = []
    for letter in "CP":

        def change(key: str, letter=letter) -> float:
            return material.mean(remedy, share, letter, key) - material.mean(remedy, 0.0, letter, key)

        flips = [material.mean(remedy, s, letter, "flip") for s in (0.0, share)]
        worst = (material.levels(remedy, share, letter) - material.levels(remedy, 0.0, letter)).min()
        parts.append(
            f"against {letter} {change('mean_db'):+.2f} dB, from level {COARSE} on {change('coarse_db'):+.2f}, the "
            f"worst level {worst:+.2f}, FLIP {flips[0]:.4f} to {flips[1]:.4f}"
        )
    seeds = material.values(remedy, share)
    spread = f", {min(seeds):.2f} to {max(seeds):.2f} dB over {len(seeds)} seeds" if len(seeds) > 1 else ""
    psnr = f"{material.mean(remedy, share):.2f} dB{spread}"
    lines = [f"{material.name}: the best lambda is {share:g}, {remedy} ({psnr}); over lambda = 0, {'; '.join(parts)}"]
    base, small = material.mean(remedy, 0.0), [s for s in material.shares(remedy) if 0 < s <= 0.25]
    if small and share not in small:
        text = enumeration([f"{material.mean(remedy, s) - base:+.2f} dB at {s:g}" for s in small])
        lines.append(f"{material.name}: in the paper's range of lambda, against C, {text}")
    return lines


def _against_classical(material: MaterialCurves) -> list[str]:
    """Compare the kernel with filtered parameters, and the best λ with classical filters."""
    lines, best_filter, best = [], material.best_classical, material.best()
    if best_filter is None:
        return lines
    base = material.classical.get("filtered", material.classical[best_filter])["C"]["mean_db"]
    kernel = material.classical.get("kernel")
    if kernel:
        gain = kernel["C"]["mean_db"] - base
        lines.append(f"{material.name}: the kernel alone, uncompressed, is worth {gain:+.2f} dB against C over "
                     "filtered parameters")  # fmt: skip
    if best is None:
        return lines
    ours_c, ours_p = (material.mean(*best, letter) for letter in "CP")
    gains = [f"{label} {ours_c - d['C']['mean_db']:+.2f} (P {ours_p - d['P']['mean_db']:+.2f})"
             for label, d in {**material.filters, **material.compressed}.items()]  # fmt: skip
    lines.append(f"{material.name}: lambda {best[1]:g}, compressed, beside uncompressed and compressed classical "
                 f"filters, dB against C: {', '.join(gains)}")  # fmt: skip
    for label in ("LEAN", "LEAN, kernel"):
        if label not in material.filters:
            continue
        lean = material.filters[label]["C"]
        ahead = [f"{i} ({d:+.2f} dB)" for i, d in enumerate(lean["psnr_db"] - material.levels(*best)) if d > 0]
        verdict = "wins" if lean["mean_db"] > ours_c else "loses"
        where = f"it is ahead on level {enumeration(ahead)}" if ahead else "on no level is it ahead"
        lines.append(f"{material.name}: uncompressed mip maps with {label} {verdict} against C "
                     f"({lean['mean_db']:.2f} to {ours_c:.2f} dB); {where}")  # fmt: skip
    return lines


def _effects_of_remedies(material: MaterialCurves) -> list[str]:
    """Compare runs with and without remedies at the best λ and at the largest."""
    lines, best = [], material.best()
    largest = max((s for s in material.shares(WITH) if s > 0), default=None)
    for share in dict.fromkeys(s for s in (best and best[1], largest) if s is not None):
        for other, effect in (("no clip, schedule", "clipping"), ("clip, no schedule", "the falling rate"),
                              (WITHOUT, "both remedies")):  # fmt: skip
            if (other, share) not in material.runs or (WITH, share) not in material.runs:
                continue
            gains = (material.mean(WITH, share, letter) - material.mean(other, share, letter) for letter in "CP")
            text = " and ".join(f"{g:+.2f} dB against {letter}" for g, letter in zip(gains, "CP", strict=True))
            lines.append(f"{material.name}, lambda {share:g}: {effect} gives {text}")
    return lines
