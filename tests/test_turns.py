"""Python threads that load and render wait for one another."""

import inspect
import subprocess
import sys
import threading

import mi_diffind as md
from mi_diffind import turns


def scene() -> dict:
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    ball = {"type": "sphere", "center": [0, 0, 5], "bsdf": {"type": "disney", "roughness": 0.4}}
    return {
        "type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "film": film}, "ball": ball,
    }  # fmt: skip


THREADS = f"""
import threading
import mi_diffind as md, mitsuba as mi, numpy as np
{inspect.getsource(scene)}
mi.set_variant("llvm_ad_rgb")

def picture():
    return np.array(mi.render(md.load_dict(scene()), spp=2, seed=1))

expected, found = picture(), []
threads = [threading.Thread(target=lambda: [found.append(picture()) for _ in range(4)]) for _ in range(3)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert len(found) == 12 and all((image == expected).all() for image in found), len(found)
"""


def test_threads_with_scenes_of_their_own():
    """Without turns, this process ends by a signal, or images are missing."""
    result = subprocess.run([sys.executable, "-c", THREADS], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr[-1500:]


def test_loads_and_renders_wait(mi_rgb):
    loaded = md.load_dict(scene())
    for work in (lambda: mi_rgb.render(loaded, spp=1), lambda: md.load_dict(scene())):
        done = threading.Event()
        thread = threading.Thread(target=lambda work=work, done=done: (work(), done.set()))
        with turns.LOCK:
            thread.start()
            assert not done.wait(0.3)
            mi_rgb.render(loaded, spp=1)  # the thread that holds the lock goes on
        thread.join()
        assert done.is_set()


def test_scenes_of_threads_end_in_a_turn(mi_rgb):
    """A scene of a thread is kept until the next load or render if nothing refers to it, one of the main thread is not."""
    kept = []
    with turns.turn():
        pass
    before = len(turns._scenes)

    def load():
        kept.append(md.load_dict(scene()))
        mi_rgb.render(kept[-1], spp=1)

    load()
    assert len(turns._scenes) == before
    thread = threading.Thread(target=load)
    thread.start()
    thread.join()
    with turns.turn():
        assert len(turns._scenes) == before + 1
    kept.clear()
    assert len(turns._scenes) == before + 1
    with turns.turn():
        assert len(turns._scenes) == before
