"""Python threads that load and render wait for one another."""

import threading

import mi_diffind as md
from mi_diffind.core import threads


def scene() -> dict:
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    ball = {"type": "sphere", "center": [0, 0, 5], "bsdf": {"type": "disney", "roughness": 0.4}}
    return {
        "type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "film": film}, "ball": ball,
    }  # fmt: skip


def test_loads_and_renders_wait(mi_rgb):
    loaded = md.load_dict(scene())
    for work in (lambda: mi_rgb.render(loaded, spp=1), lambda: md.load_dict(scene())):
        done = threading.Event()
        thread = threading.Thread(target=lambda work=work, done=done: (work(), done.set()))
        with threads.LOCK:
            thread.start()
            assert not done.wait(0.3)
            mi_rgb.render(loaded, spp=1)  # the thread that holds the lock goes on
        thread.join()
        assert done.is_set()


def test_scenes_of_threads_end_in_a_turn(mi_rgb):
    """A scene of a thread that nothing refers to ends at the next load or render; one of the main thread at once."""
    kept = []
    with threads.turn():
        pass
    before = len(threads._scenes)

    def load():
        kept.append(md.load_dict(scene()))
        mi_rgb.render(kept[-1], spp=1)

    load()
    assert len(threads._scenes) == before
    thread = threading.Thread(target=load)
    thread.start()
    thread.join()
    with threads.turn():
        assert len(threads._scenes) == before + 1
    kept.clear()
    assert len(threads._scenes) == before + 1
    with threads.turn():
        assert len(threads._scenes) == before
