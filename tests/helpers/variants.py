"""Mitsuba variants that the tests run in."""

import os

import drjit as dr

import mi_diffind  # noqa: F401  (chooses LLVM before anything else)

#: Variants that the plugins support, each in its CPU form; the CUDA twins follow where there is a GPU.
COLOUR_MODES = ("ad_rgb", "ad_mono", "ad_mono_polarized", "ad_spectral", "ad_spectral_polarized")
#: MI_DIFFIND_BACKENDS="cuda" leaves out the CPU.
BACKENDS = ("llvm", "cuda") if dr.has_backend(dr.JitBackend.CUDA) else ("llvm",)
if CHOSEN := os.environ.get("MI_DIFFIND_BACKENDS"):
    BACKENDS = tuple(CHOSEN.split(","))
VARIANTS = [f"{backend}_{kind}" for backend in BACKENDS for kind in COLOUR_MODES]


def set_variant(name):
    """``mitsuba`` with a variant set, quiet."""
    import mitsuba as mi

    mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def warnings_of(mi, monkeypatch):
    """What Mitsuba is told to warn of from here on."""
    report = []
    mi.set_log_level(mi.LogLevel.Warn)  # commands that ran before may have asked for less
    monkeypatch.setattr(mi, "Log", lambda level, text: report.append(text) if level == mi.LogLevel.Warn else None)
    return report
