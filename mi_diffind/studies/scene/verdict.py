"""What the study of a scene comes to, in a sentence."""

from __future__ import annotations

from ...measure.bias import PRACTICAL, practical
from ...measure.formatting import duration, percent, rounded


def verdict(result: dict) -> str | None:
    """What it comes to, in a sentence."""
    bias, crossover, counts = result["bias"], result["crossover"], result["counts"]
    if bias is None:
        return None
    if not bias["measured"]:
        if not bias["rmse_below"]:
            return "Learned and exact renders do not differ at all."
        limit = "at any practical number of samples"
        if practical(crossover):
            limit = f"up to {rounded(crossover['spp_above'])} spp at least"
        return (
            f"No bias was found; if there is one, it is below {percent(bias['rmse_below'])}, and noise dominates "
            f"{limit}."
        )
    size, spp = percent(bias["rmse"]), crossover["spp"]
    if bias["rounding_only"]:
        return f"Learned and exact renders differ by rounding only ({size}): noise dominates at any sample count."
    if not practical(crossover):
        return (
            f"Noise dominates: the bias of the approximation, {size}, is below what any practical number of samples "
            f"(up to {rounded(PRACTICAL)} a pixel) would show."
        )
    if spp < counts[0]:
        return f"The approximation dominates throughout: its bias, {size}, exceeds the noise of {counts[0]} spp."
    when = f"about {rounded(spp)} spp" + (f" ({duration(crossover['seconds'])})" if crossover["seconds"] else "")
    if spp <= counts[-1]:
        return f"Up to {when} noise dominates; beyond, the bias of the approximation, {size}, and time hardly helps."
    last = next((p for p in reversed(result["points"]) if p["version"] == "learned" and p["timed"]), None)
    most = f"{counts[-1]} spp" + (f" ({duration(last['seconds'])})" if last else "")
    return (
        f"Noise dominates at all that was measured, up to {most}; by extrapolation, it would equal the bias of the "
        f"approximation, {size}, at {when}."
    )
