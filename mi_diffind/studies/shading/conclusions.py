"""
What the study of shading says. All of it is of the records of its jobs, so that an interrupted run has what there is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...measure.formatting import enumeration, grid

#: The way with both remedies, and the one without.
WITH, WITHOUT = "clip, schedule", "no clip, no schedule"

#: Classical filters and the control of the kernel, and those with that kernel.
PLAIN = ("Toksvig", "LEAN", "baked", "kernel")
COMBINED = ("LEAN, kernel", "baked, kernel")

#: Levels of detail from this one on are coarse.
COARSE = 2


@dataclass
class Curves:
    """
    A material: ``classical`` and ``compressed``, label → details; ``runs``, (way, λ) → details of its seeds, those of
    λ = 0 under every way that they are the base of.
    """

    name: str
    classical: dict[str, dict] = field(default_factory=dict)
    compressed: dict[str, dict] = field(default_factory=dict)
    runs: dict[tuple[str, float], list[dict]] = field(default_factory=dict)

    @property
    def ways(self) -> list[str]:
        return list(dict.fromkeys(way for way, share in self.runs if share > 0))

    def shares(self, way: str) -> list[float]:
        return sorted(share for w, share in self.runs if w == way)

    def values(self, way: str, share: float, letter: str = "C", what: str = "mean_db") -> list[float]:
        """Of each seed: ``mean_db``, ``coarse_db`` or ``flip``."""
        found = [d[letter] for d in self.runs.get((way, share), [])]
        return [float(np.mean(f["flip"])) if what == "flip" else f[what] for f in found if f.get(what)]

    def mean(self, *key) -> float:
        values = self.values(*key)
        return float(np.mean(values)) if values else float("nan")

    def levels(self, way: str, share: float, letter: str = "C") -> np.ndarray:
        """PSNR of each level, the mean over seeds."""
        return np.mean([d[letter]["psnr_db"] for d in self.runs[way, share]], axis=0)

    def best(self) -> tuple[str, float] | None:
        """The way and λ > 0 with the best mean against C, of ways that λ = 0 is known of; ``None`` if there is none."""
        known = [(way, s) for way, s in self.runs if s > 0 and (way, 0.0) in self.runs]
        return max(known, key=lambda key: self.mean(*key), default=None)

    @property
    def best_classical(self) -> str | None:
        """The best classical filter against C, uncompressed."""
        known = [label for label in (*PLAIN, *COMBINED) if label in self.classical]
        return max(known, key=lambda label: self.classical[label]["C"]["mean_db"], default=None)


def curves(result: dict) -> dict[str, Curves]:
    """All materials of which anything was measured."""
    found: dict[str, Curves] = {}
    for record in result["jobs"].values():
        d = record.get("details", {})
        if "material" not in d:
            continue
        own = found.setdefault(d["material"], Curves(d["material"]))
        if d["kind"] in ("classical", "compressed"):
            getattr(own, d["kind"])[d["label"]] = d
        elif d["kind"] == "run":
            own.runs.setdefault((d["way"], d["share"]), []).append(d)
    for own in found.values():
        bases = {d["schedule"]: way for (way, share), ds in own.runs.items() if share == 0 for d in ds}
        for way in own.ways:
            plain = next(ds[0]["schedule"] for (w, s), ds in own.runs.items() if w == way and s > 0)
            if plain in bases:
                own.runs[way, 0.0] = own.runs[bases[plain], 0.0]
    return found


# -- the table --------------------------------------------------------------------------------------------------------


def table(result: dict) -> list[str]:
    """Of each material, what was measured against both truths; levels are those against C."""
    lines = []
    for own in curves(result).values():
        levels = len(next(iter(own.classical.values()))["C"]["psnr_db"]) if own.classical else 0
        cells = [[own.name, "bytes", "C", "low", "high", "coarse", "FLIP", *(f"L{i}" for i in range(levels)), "P",
                  "coarse", "FLIP", "trouble"]]  # fmt: skip
        for label, d in {**own.classical, **own.compressed}.items():
            cells.append(_row(f"{label}, uncompressed" if label in own.classical else label, "", [d], levels))
        for way in own.ways or dict.fromkeys(way for way, _ in own.runs):
            for share in own.shares(way):
                text = trouble(own.runs[way, share])
                cells.append([*_row(f"lambda {share:g}, {way}", "", own.runs[way, share], levels)[:-1], text])
        sizes = {d["label"]: r["bytes"] for r in result["jobs"].values() if (d := r["details"]).get("label")
                 and d["material"] == own.name}  # fmt: skip
        ours = next((r["bytes"] for r in result["jobs"].values() if r["details"].get("kind") == "run"
                     and r["details"]["material"] == own.name), 0)  # fmt: skip
        for row in cells[1:]:
            row[1] = f"{sizes.get(row[0].removesuffix(', uncompressed'), ours):,}"
        lines += ["", *grid(cells, "")]
    return lines[1:]


def _row(name: str, nbytes: str, found: list[dict], levels: int) -> list[str]:
    def mean(letter: str, what: str, digits: int) -> str:
        values = [np.mean(d[letter][what]) for d in found if d[letter][what]]
        return f"{np.mean(values):.{digits}f}" if values else "-"

    c = [d["C"]["mean_db"] for d in found]
    own = [f"{np.mean([d['C']['psnr_db'][i] for d in found]):.1f}" for i in range(levels)]
    return [name, nbytes, f"{np.mean(c):.2f}", f"{min(c):.2f}", f"{max(c):.2f}", mean("C", "coarse_db", 2),
            mean("C", "flip", 4), *own, mean("P", "mean_db", 2), mean("P", "coarse_db", 2), mean("P", "flip", 4),
            ""]  # fmt: skip


def trouble(runs: list[dict]) -> str:
    """What went wrong, and in how many of the runs."""
    words = [word for d in runs for word in d.get("trouble", [])]
    return ", ".join(f"{word} {words.count(word)}" for word in dict.fromkeys(words))


# -- sentences --------------------------------------------------------------------------------------------------------


def conclusions(result: dict) -> list[str]:
    """Gains over λ = 0 and over classical filters, what remedies do, what went wrong."""
    found, lines = curves(result), []
    for own in found.values():
        lines += _gains(own) + _classical(own) + _remedies(own)
    runs = [(way, share, d) for own in found.values() for (way, share), ds in own.runs.items() if share > 0
            for d in ds]  # fmt: skip
    for way in dict.fromkeys(way for way, _, _ in runs):
        of_way = [d for w, _, d in runs if w == way]
        kinds = {word: sum(word in d["trouble"] for d in of_way) for word in _WORDS}
        text = enumeration([f"{n} {_WORDS[word]}" for word, n in kinds.items()])
        lines.append(f"{way}: of {len(of_way)} runs with lambda > 0, {text}")
    return lines


#: Kinds of trouble, as a sentence about so many runs has them.
_WORDS = {
    "nan": "met a NaN",
    "diverged": "were given up",
    "restarts": "were restarted",
    "spike": "had a loss above ten times its median",
    "drift": "ended below their best state",
    "below": "ended below lambda = 0",
}


def _gains(own: Curves) -> list[str]:
    """The best λ against λ = 0, in everything that was measured."""
    best = own.best()
    if best is None:
        return []
    lines, parts = [], []
    way, share = best
    for letter in "CP":
        gain, coarse = (
            own.mean(way, share, letter, w) - own.mean(way, 0.0, letter, w) for w in ("mean_db", "coarse_db")
        )
        flips = [own.mean(way, s, letter, "flip") for s in (0.0, share)]
        worst = (own.levels(way, share, letter) - own.levels(way, 0.0, letter)).min()
        parts.append(
            f"against {letter} {gain:+.2f} dB, from level {COARSE} on {coarse:+.2f}, the worst level {worst:+.2f}, "
            f"FLIP {flips[0]:.4f} to {flips[1]:.4f}"
        )
    seeds = own.values(way, share)
    spread = f", {min(seeds):.2f} to {max(seeds):.2f} dB over {len(seeds)} seeds" if len(seeds) > 1 else ""
    lines.append(
        f"{own.name}: the best lambda is {share:g}, {way} ({own.mean(way, share):.2f} dB{spread}); over lambda = 0, "
        f"{'; '.join(parts)}"
    )
    others = [s for s in own.shares(way) if 0 < s <= 0.25]
    if others and share not in others:
        text = enumeration([f"{own.mean(way, s) - own.mean(way, 0.0):+.2f} dB at {s:g}" for s in others])
        lines.append(f"{own.name}: in the paper's range of lambda, against C, {text}")
    return lines


def _classical(own: Curves) -> list[str]:
    lines, best, ours_key = [], own.best_classical, own.best()
    if best is None:
        return lines
    plain = own.classical.get("filtered", own.classical[best])["C"]["mean_db"]
    kernel = own.classical.get("kernel")
    if kernel:
        lines.append(f"{own.name}: the kernel alone, uncompressed, is worth {kernel['C']['mean_db'] - plain:+.2f} dB "
                     "against C over filtered parameters")  # fmt: skip
    if ours_key is None:
        return lines
    way, share = ours_key
    ours, ours_p = (own.mean(way, share, letter) for letter in "CP")
    known = {label: own.classical[label] for label in (*PLAIN, *COMBINED) if label in own.classical}
    parts = [f"{label} {ours - d['C']['mean_db']:+.2f} (P {ours_p - d['P']['mean_db']:+.2f})" for label, d in
             {**known, **own.compressed}.items()]  # fmt: skip
    lines.append(f"{own.name}: lambda {share:g}, compressed, beside uncompressed and compressed classical filters, dB "
                 f"against C: {', '.join(parts)}")  # fmt: skip
    for label in ("LEAN", "LEAN, kernel"):
        if label not in known:
            continue
        levels = np.asarray(known[label]["C"]["psnr_db"]) - own.levels(way, share)
        ahead = [f"{i} ({d:+.2f} dB)" for i, d in enumerate(levels) if d > 0]
        wins = known[label]["C"]["mean_db"] > ours
        verdict = "wins" if wins else "loses"
        where = f"it is ahead on level {enumeration(ahead)}" if ahead else "on no level is it ahead"
        lines.append(f"{own.name}: uncompressed mip maps with {label} {verdict} "
                     f"against C ({known[label]['C']['mean_db']:.2f} to {ours:.2f} dB); {where}")  # fmt: skip
    return lines


def _remedies(own: Curves) -> list[str]:
    """What clipping and the schedule are worth at the largest λ, and at the best."""
    lines = []
    shares = [s for s in own.shares(WITH) if s > 0]
    best = own.best()
    for share in dict.fromkeys(s for s in (best and best[1], max(shares, default=None)) if s is not None):
        for other, what in (("no clip, schedule", "clipping"), ("clip, no schedule", "the falling rate"),
                            (WITHOUT, "both remedies")):  # fmt: skip
            if (other, share) not in own.runs or (WITH, share) not in own.runs:
                continue
            gains = (own.mean(WITH, share, letter) - own.mean(other, share, letter) for letter in "CP")
            text = " and ".join(f"{g:+.2f} dB against {letter}" for g, letter in zip(gains, "CP", strict=True))
            lines.append(f"{own.name}, lambda {share:g}: {what} gives {text}")
    return lines
