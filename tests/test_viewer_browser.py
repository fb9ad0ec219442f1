"""The page of ``mi-diffind view`` in headless Chromium: it loads, moves, and a slider changes the picture."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]

#: Chromium, without a sandbox, which containers do not allow, and without reaching other machines.
OPTIONS = [
    *("--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]

#: Part of the window that shows the picture and no message, pixels: left, upper, right, lower.
PICTURE = (330, 150, 700, 450)

SCENE = """
<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <emitter type="constant"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0.6, 0.8, 3.5" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="160"/><integer name="height" value="90"/>
            <rfilter type="box"/></film>
        <sampler type="independent"><integer name="sample_count" value="8"/></sampler>
    </sensor>
    <shape type="cube"><bsdf type="neural_disney" id="paint"><rgb name="base_color" value="0.8, 0.2, 0.1"/></bsdf>
        <transform name="to_world"><scale value="0.6"/></transform></shape>
</scene>
"""


@pytest.fixture(scope="module")
def chromium():
    sync_api = pytest.importorskip(
        "playwright.sync_api", reason="playwright, which drives the browser, is not installed"
    )
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium is installed")
    with sync_api.sync_playwright() as playwright:
        yield lambda folder: playwright.chromium.launch_persistent_context(
            folder, executable_path=program, headless=True, viewport={"width": 1100, "height": 620}, args=OPTIONS
        )


@pytest.fixture
def served(tmp_path):
    """The command and the address that it prints."""
    pytest.importorskip("viser", reason="the optional package viser is not installed")
    (tmp_path / "scene.xml").write_text(SCENE)
    command = [
        sys.executable,
        "-m",
        "mi_diffind.commands.cli",
        "view",
        "scene.xml",
        "--port",
        "0",
        "--variant",
        "llvm_ad_rgb",
    ]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        line = process.stdout.readline()
        url = re.search(r"http://127\.0\.0\.1:\d+", line)
        assert url, line + process.stdout.read()
        yield process, url[0]
    finally:
        process.kill()
        process.wait()


def wait_for(page, text: str, seconds: float = 120) -> str:
    """Wait until the panel has a text that matches, and return the match."""
    end = time.monotonic() + seconds
    while not (match := re.search(text, page.inner_text("body"))):
        assert time.monotonic() < end, page.inner_text("body")
        time.sleep(0.1)
    return match[0]


def picture(page, path: Path, seconds: float = 60) -> np.ndarray:
    """The part of the window with the picture, once all samples are there and nothing changes any more."""
    time.sleep(0.5)
    wait_for(page, r"samples\s+8 of 8")
    end, before = time.monotonic() + seconds, None
    while True:
        time.sleep(0.5)
        page.screenshot(path=path)
        shown = np.asarray(Image.open(path).convert("RGB").crop(PICTURE), float)
        if before is not None and (shown == before).all():
            return shown
        assert time.monotonic() < end, "the picture does not come to rest"
        before = shown


def after(page, label: str, element: str):
    """The first element of the panel after a label."""
    return page.locator(f"xpath=//label[normalize-space()='{label}']/following::{element}").first


def listening(pid: int) -> set[str]:
    """Addresses at which a process listens, as Linux lists them, in hexadecimal."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        target = os.readlink(link) if link.is_symlink() else ""
        inodes |= {target[8:-1]} if target.startswith("socket:[") else set()
    addresses = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                addresses.add(fields[1].partition(":")[0])
    return addresses


@pytest.mark.long
def test_the_page(chromium, served, tmp_path):
    process, url = served
    with chromium(str(tmp_path / "profile")) as browser:
        page, complaints = browser.new_page(), []
        page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(url)
        first = picture(page, tmp_path / "first.png")
        assert first.std() > 5  # a ball before its surroundings
        panel = page.inner_text("body")
        assert re.search(r"error \d+\.\d dB against exact", panel) and "384 in tables" in panel

        # The camera follows the mouse
        page.mouse.move(450, 320)
        page.mouse.down()
        for step in range(12):
            page.mouse.move(450 + 8 * step, 320 + 3 * step)
            time.sleep(0.03)
        page.mouse.up()
        moved = picture(page, tmp_path / "moved.png")
        assert np.abs(moved - first).mean() > 3

        page.get_by_role("button", name="first view").click()
        back = picture(
            page, tmp_path / "back.png"
        )  # noise differs: the page draws at the resolution that it can afford
        assert np.abs(back - first).mean() < np.abs(moved - first).mean() / 4

        # A slider of a plugin
        after(page, "find", "input").fill("paint.metallic")
        wait_for(page, "metallic")
        slider = after(page, "metallic", '*[@role="slider"]')
        slider.focus()
        slider.press("End")
        changed = picture(page, tmp_path / "changed.png")
        assert np.abs(changed - first).mean() > 3
        assert not complaints, complaints
    assert listening(process.pid) == {"0100007F"}  # 127.0.0.1 alone
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0 and "Traceback" not in output, output
