"""Warnings of what a render would do wrong in silence: leave out a shape that no integrator sees, or filter no texture.

Scenes that ``mi_diffind`` loads are prepared, or refused. Those of ``mi.load_file``, ``mi.load_dict`` and
``mi.load_string`` are checked when they are rendered: by ``mi.render`` (:func:`.before_render`), and by ``render`` of
integrators of this package. Each scene is warned of once.
"""

from __future__ import annotations

import weakref

import mitsuba as mi

from mi_diffind.core import compat, threads

from .. import origin, warn

#: Instances not warned of yet (:func:`watch`).
_watched: weakref.WeakSet = weakref.WeakSet()

#: Ids of a scene, an integrator and a sensor that were checked together since the last instance was watched.
_checked: set[tuple[int, int, int]] = set()

#: Largest number of these that are remembered.
MOST = 1024


def watch(instance) -> None:
    """Have a plugin's instance checked before renders.

    Its method ``omitted(integrators, sensor)`` returns a sentence if none of these integrators, nested ones included,
    renders it as it should be, else "".
    """
    _watched.add(instance)
    recheck()


def recheck() -> None:
    """Check all scenes again at their next render; instances that were warned of stay unwatched."""
    _checked.clear()


def settle(instances) -> None:
    """Warn of these ``instances`` no more."""
    for instance in list(instances):
        _watched.discard(instance)


def check(scene, integrator=None, sensor=0) -> None:
    """Warn of watched instances in a scene that an integrator (default: the scene's) leaves out.

    ``sensor`` is the number of one of the scene's, or a sensor.
    """
    if not _watched or not isinstance(scene, mi.Scene):
        return
    integrator = scene.integrator() if integrator is None else integrator
    if isinstance(sensor, int):
        sensor = scene.sensors()[sensor] if 0 <= sensor < len(scene.sensors()) else None
    ids = id(scene), id(integrator), id(sensor)
    if ids in _checked or not isinstance(integrator, mi.Integrator):
        return
    if len(_checked) >= MOST:
        _checked.clear()
    _checked.add(ids)
    integrators = compat.scene_objects(integrator)
    groups: dict[str, list] = {}
    for instance in compat.scene_objects(scene):
        if instance in _watched:
            groups.setdefault(plugin_of(instance), []).append(instance)
    for instances in groups.values():
        sentences = [sentence for instance in instances if (sentence := instance.omitted(integrators, sensor))]
        if sentences:
            settle(instances)
            warn(f"{sentences[0]} ({len(sentences) - 1} more likewise)" if len(sentences) > 1 else sentences[0])


def plugin_of(instance) -> str:
    """Return the name of an instance's plugin, or of its class if no plugin's factory created it."""
    described = origin(instance)
    return type(instance).__name__ if described is None else described["plugin"]


# Once in a process: plugins are executed anew for each variant, this module is not
threads.before_render(check)
