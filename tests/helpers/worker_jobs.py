"""Jobs for other processes, which know functions by their modules."""

import ctypes
import dataclasses
import os
import signal
import time
from pathlib import Path

from mi_diffind.core.errors import UsageError
from mi_diffind.tasks.bsdf import energy, library, mixture, training

_fit_material = library.fit_material

#: Constants of a quick fit.
QUICK = {
    (training, "PROXY"): dataclasses.replace(training.PROXY, steps=10, measure_every=10),
    (training, "SAMPLES"): 2**16,
    (training, "START_ALPHAS"): (0.1, 0.4),
    (mixture, "ALPHAS"): (0.05, 0.3),
    (energy, "CORRECTIONS"): 2,
}


def square(x):
    """Return x², and the process; a word is refused."""
    if isinstance(x, str):
        raise UsageError(f"found the word {x}")
    return x * x, os.getpid()


def kill_once(mark, process=os.getpid):
    """Kill a process, this one, unless the file ``mark`` says that it was done before; return the process."""
    if not Path(mark).exists():
        Path(mark).touch()
        os.kill(process(), signal.SIGKILL)
        time.sleep(60)
    return os.getpid()


def interrupt(x):
    """Send this process a Ctrl-C if ``x`` is 2, and return it; a word fails after the Ctrl-C."""
    if x == 2 or isinstance(x, str):
        signal.raise_signal(signal.SIGINT)
    return x * 1.0


def write_process_and_sleep(path):
    """Write the number of this process to a file, and sleep."""
    Path(path).write_text(str(os.getpid()))
    time.sleep(60)


def write_process_and_hold_python(path):
    """Write the number of this process to a file, and sleep in C, where no other thread of Python runs."""
    Path(path).write_text(str(os.getpid()))
    ctypes.PyDLL(None).sleep(200)


def fit_quickly(material):
    """Fit a material of a library, with a proxy of few steps; one called "killed" kills its process once."""
    for (module, name), value in QUICK.items():
        setattr(module, name, value)
    if Path(material.path).stem == "killed":
        kill_once(f"{material.path}.mark")
    return _fit_material(material)
