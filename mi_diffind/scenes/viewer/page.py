"""Page of the viewer in a browser: viser sends the camera and the sliders, and shows the picture."""

from __future__ import annotations

import contextlib
import gc
import io
import math
import socket
import threading
import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from ...core.errors import DiffindError, UsageError, missing_package
from ...images import srgb
from .passes import no_collection
from .session import Session

#: Seconds without a movement after which the picture is refined.
QUIET = 0.3

#: Parameters that have a slider at once; the search shows others.
MOST_SLIDERS = 60

#: Steps of a slider.
STEPS = 200

#: Quality of pictures as JPEG while the camera moves.
MOVING_QUALITY = 75

#: Quality of pictures as JPEG at rest.
QUALITY = 92

#: Seconds between two collections of garbage.
COLLECTED = 20.0

#: Seconds between two refined pictures that are sent; all samples are in each.
INTERVAL = 0.1


def server(host: str, port: int):
    """Return a running viser server at ``host`` and ``port``, 0 for a free one.

    Raises :class:`.UsageError` if viser is not installed or the address cannot be bound.
    """
    try:
        import viser
    except ImportError:
        raise UsageError(f"view: needs {missing_package('viser')}") from None
    if not isinstance(port, int) or not 0 <= port <= 65535:
        raise UsageError(f"port: found {port}, allowed are whole numbers from 0 to 65535")
    try:
        with contextlib.closing(socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((host, port))
            port = trial.getsockname()[1]
    except (OSError, UnicodeError) as e:
        problem = e.strerror if isinstance(e, OSError) and e.strerror else "no such address"
        raise UsageError(f"{host}:{port}: the page cannot be served there ({problem})") from None
    with contextlib.redirect_stdout(io.StringIO()):  # a banner
        return viser.ViserServer(host=host, port=port, verbose=False)


class Page:
    """Page of a session: controls that change it, and the loop that renders (:meth:`run`).

    viser calls back in threads of its own; they only leave requests, which the loop carries out. Of several requests
    with the same key, such as the value of one parameter, the newest counts.
    """

    def __init__(self, session: Session, viser_server):
        self.session, self.server = session, viser_server
        self._requests: dict[object, Callable[[], None]] = {}
        self._camera: tuple | None = None  # the newest position and orientation that nobody has looked from
        self._lock, self._wake = threading.Lock(), threading.Event()
        self._moved, self._sent = -math.inf, -math.inf
        self._message, self._picture = "", None
        self._halted = False  # after a refused picture, until something changes
        self._controls()
        self.server.on_client_connect(self._connected)

    # -- controls -----------------------------------------------------------------------------------------------------

    def _controls(self) -> None:
        session, gui = self.session, self.server.gui
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(f"mi-diffind view: {session.name}")
        self.server.scene.set_up_direction(tuple(session.up()))
        self._begin_at(self.server.initial_camera)
        self.server.initial_camera.up = tuple(session.up())
        self._status = gui.add_markdown("Compiling the scene …")
        view = gui.add_dropdown("view", session.views, initial_value=session.view)
        divider = gui.add_slider("divider", 0.0, 1.0, 0.01, session.divider)
        gain = gui.add_slider("gain", 1.0, 100.0, 1.0, session.gain, hint="factor of the difference")
        spp = gui.add_number("samples", session.spp, min=1, max=2**16, step=1, hint="samples per pixel")
        self._on_update(view, lambda view: session.show(view=view))
        self._on_update(divider, lambda value: session.show(divider=value))
        self._on_update(gain, lambda value: session.show(gain=value))
        self._on_update(spp, lambda value: session.samples(int(value)))
        gui.add_button("first view").on_click(lambda event: self._ask(self._first_view))
        self._search = gui.add_text("find", "", hint="part of the names of the parameters to show")
        self._on_update(self._search, lambda text: self._list_parameters())
        self._folders: list = []
        self._list_parameters()

    def _on_update(self, control, change: Callable[[object], object]) -> None:
        """Call ``change`` with the value of a control whenever that changes, in the loop."""
        control.on_update(lambda event: self._ask(lambda: change(control.value)))

    def _begin_at(self, camera) -> None:
        """Give a camera of viser the place and the target of the first view."""
        camera.position, camera.look_at = tuple(self.session.start[:3, 3]), tuple(self.session.target())

    def _list_parameters(self) -> None:
        """Show the sliders of the parameters whose names contain the text of the search, a folder for each object."""
        for folder in self._folders:
            folder.remove()
        words = self._search.value.lower().split()
        listed = [p for p in self.session.parameters.values() if all(word in p.path.lower() for word in words)]
        by_owner: dict[str, list] = {}
        for parameter in listed[:MOST_SLIDERS]:
            by_owner.setdefault(parameter.owner, []).append(parameter)
        self._folders = []
        for owner, parameters in by_owner.items():
            folder = self.server.gui.add_folder(owner, expand_by_default=len(by_owner) < 3)
            self._folders.append(folder)
            with folder:
                for parameter in parameters:
                    self._slider(parameter)
        if len(listed) > MOST_SLIDERS:
            hidden = len(listed) - MOST_SLIDERS
            self._folders.append(self.server.gui.add_markdown(f"{hidden} more parameters: find them by their names"))

    def _slider(self, parameter) -> None:
        """Show the control of a parameter: a slider, a colour picker, or numbers for a colour beyond [0, 1]."""
        gui, path = self.server.gui, parameter.path
        value = self.session.learned.parameters.value(path)
        hint = path if self.session.on_both(path) else f"{path}: of the learned side only"
        picked = parameter.is_colour and min(value) >= 0 and max(value) <= 1 and parameter.high == 1
        if picked:
            shown = tuple(int(x) for x in np.round(255 * srgb.from_linear(np.array(value))))
            control = gui.add_rgb(parameter.name, shown, hint=hint)
        elif parameter.is_colour:
            control = gui.add_vector3(parameter.name, value, step=parameter.high / STEPS, hint=hint)
        else:
            low, high = min(parameter.low, value), max(parameter.high, value)
            control = gui.add_slider(parameter.name, low, high, (high - low) / STEPS, value, hint=hint)

        def change(event) -> None:
            linear = srgb.to_linear(np.array(control.value) / 255).tolist() if picked else control.value
            self._change(path, linear)

        control.on_update(change)

    def _change(self, path: str, value) -> None:
        """Ask for another value of a parameter."""
        self._ask(lambda: self.session.set({path: value}), path)

    def _first_view(self) -> None:
        for client in self.server.get_clients().values():
            with client.atomic():
                client.camera.up_direction = tuple(self.session.up())
                self._begin_at(client.camera)
        self._move(self.session.start)

    # -- events of viser, in its threads ------------------------------------------------------------------------------

    def _ask(self, request: Callable[[], None], key: object = None) -> None:
        with self._lock:
            self._requests[request if key is None else key] = request
        self._wake.set()

    def _connected(self, client) -> None:
        client.camera.on_update(self._camera_moved)
        self._ask(lambda: self._send(client))

    def _camera_moved(self, camera) -> None:
        with self._lock:
            self._camera = (np.array(camera.wxyz), np.array(camera.position))
        self._wake.set()

    # -- the loop -----------------------------------------------------------------------------------------------------

    def run(self, stop: threading.Event, seconds: float | None = None) -> None:
        """Render until ``stop`` is set, or for some seconds: while the camera moves, then until all samples are there.

        A refusal is shown on the page, and the scene stays as it was. Raises
        :class:`.SceneError` if the scene cannot be rendered at all.
        """
        start = collected = time.monotonic()
        with no_collection():  # in this thread alone: those of viser must not free what is rendered here
            while not stop.is_set() and (seconds is None or time.monotonic() - start < seconds):
                self._wake.clear()
                try:
                    busy = self._step()
                except DiffindError as e:
                    if self._picture is None:  # a scene that cannot be rendered at all
                        raise
                    self._message, self._halted, busy = str(e), True, False
                    self._show(None)
                if time.monotonic() - collected > COLLECTED:
                    gc.collect()
                    collected = time.monotonic()
                if not busy:
                    self._wake.wait(0.1)

    def _step(self) -> bool:
        """Do the next piece of work; return whether there was one."""
        with self._lock:
            requests, self._requests = self._requests, {}
            camera, self._camera = self._camera, None
        for request in requests.values():
            self._message, self._halted = "", False
            try:
                request()
            except DiffindError as e:
                self._message = str(e)
                self._list_parameters()  # sliders of the values that the scene kept
        if requests:
            self._show(self.session.picture() if self._picture is not None and self.session.passes else None)
        if camera is not None and self._move(to_world(*camera)):
            self._halted = False
            self._show(self.session.moving_picture())
            return True
        if self.session.moving and time.monotonic() - self._moved < QUIET:
            return bool(requests)
        if not self.session.finished and not self._halted:
            picture = self.session.refine()
            if self.session.finished or time.monotonic() - self._sent > INTERVAL:
                self._show(picture)
            return True
        return bool(requests)

    def _move(self, pose: np.ndarray) -> bool:
        moved = self.session.move_camera(pose)
        if moved:
            self._moved = time.monotonic()
        return moved

    def _show(self, picture: np.ndarray | None) -> None:
        if picture is not None:
            self._picture, self._sent = picture, time.monotonic()
            for client in self.server.get_clients().values():
                self._send(client)
        self._status.content = "\n\n".join(status_lines(self.session, self._message))

    def _send(self, client) -> None:
        if self._picture is not None:
            image = pad(self._picture, client.camera.aspect)
            quality = MOVING_QUALITY if self.session.moving else QUALITY
            client.scene.set_background_image(image, format="jpeg", jpeg_quality=quality)


def to_world(wxyz: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the pose of viser's camera, ``(4, 4)``: its axes point to the right, down and forward."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix() * [-1, -1, 1]
    matrix[:3, 3] = position
    return matrix


def pad(picture: np.ndarray, aspect: float) -> np.ndarray:
    """Return a picture ``(height, width, 3)`` between black bars, so that width over height is ``aspect``."""
    height, width = picture.shape[:2]
    if not math.isfinite(aspect) or not 0.05 < aspect < 20:
        return picture
    wide, high = max(width, round(height * aspect)), max(height, round(width / aspect))
    top, left = (high - height) // 2, (wide - width) // 2
    return np.pad(picture, ((top, high - height - top), (left, wide - width - left), (0, 0)))


def status_lines(session: Session, message: str = "") -> list[str]:
    """Return what the page says about its picture: time, error, bytes, and a message, as lines of Markdown."""
    f = session.figures
    times = ", ".join(f"{name} {1000 * seconds:.0f} ms" for name, seconds in f["seconds"].items()) or "no pass yet"
    lines = [
        f"**time of a pass** {times}",
        f"**samples** {f['samples']} of {f['spp']}, {f['width']} x {f['height']} pixels",
    ]
    if session.exact is None:
        lines.append(f"**error** none: {session.refusal}")
    elif f["psnr_db"] is None:
        lines.append("**error** —")
    else:
        name = session.against if session.against != "exact" else "exact plugins"
        lines.append(f"**error** {f['psnr_db']:.1f} dB against {name}, noise included")
    if f["nonfinite_pixels"]:
        lines.append(f"**not finite** {f['nonfinite_pixels']:,} pixels")
    lines.append(f"**bytes** {f['table_bytes']:,} in tables")
    return [*lines, *([f"**refused** {message}"] if message else [])]
