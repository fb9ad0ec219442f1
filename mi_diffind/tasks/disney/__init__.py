"""
Task 2: the Disney BRDF (Burley 2012), exact and as tables.

- :mod:`.model`: the reference model and what both forms share: parameters, factors, how factors make a colour;
- :mod:`.arrays`: the tables of the paper's Table 1, their encoder and decoder;
- :mod:`.sampling`: importance sampling, and the density that goes with it;
- :mod:`.training`: training distributions, per-factor targets, quality.
"""

from .arrays import DisneyArrays
from .model import Factors, Material, compose, exact_factors
from .training import DisneyProblem, fit_disney

__all__ = ["DisneyArrays", "DisneyProblem", "Factors", "Material", "compose", "exact_factors", "fit_disney"]
