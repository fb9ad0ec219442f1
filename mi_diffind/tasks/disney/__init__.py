"""
Task 2: the Disney BRDF (Burley 2012), exact and as tables.

- :mod:`.model`: the reference model and what both forms share: parameters, factors, how factors make a colour;
- :mod:`.effects`: which parts of the model a material makes use of;
- :mod:`.decoder`: the model in two steps, per material and per direction; what tables can replace;
- :mod:`.arrays`, :mod:`.paper`, :mod:`.factored`: the tables, in the paper's layout and in a better one;
- :mod:`.library`: presets, and the tables that ship;
- :mod:`.sampling`: importance sampling, and the density that goes with it;
- :mod:`.training`: training distributions, quality.
"""

from ..known import Known
from .decoder import Decoder
from .effects import Effects, find_effects
from .factored import FactoredArrays
from .library import load_decoder
from .model import Factors, Material, compose, exact_factors
from .paper import PaperArrays
from .training import DisneyProblem, fit_disney

__all__ = [
    "Decoder",
    "DisneyProblem",
    "Effects",
    "FactoredArrays",
    "Factors",
    "Known",
    "Material",
    "PaperArrays",
    "compose",
    "exact_factors",
    "find_effects",
    "fit_disney",
    "load_decoder",
]
