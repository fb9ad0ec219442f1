"""The page of ``mi-diffind view`` in headless Chromium: it loads, moves, and a slider changes the picture."""

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

#: Without a sandbox, which containers do not allow, and without reaching other machines.
OPTIONS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-background-networking"]


def wait_for(page, text: str, seconds: float = 120) -> None:
    """Wait until the panel has a text that matches."""
    end = time.monotonic() + seconds
    while not re.search(text, page.inner_text("body")):
        assert time.monotonic() < end, page.inner_text("body")
        time.sleep(0.1)


def picture(page, path: Path) -> np.ndarray:
    """The part of the window with the picture and no message, once nothing changes any more."""
    shown, before = None, 0
    while shown is None or (shown != before).any():
        time.sleep(0.5)
        wait_for(page, r"samples\s+8 of 8")
        page.screenshot(path=path)
        shown, before = np.asarray(Image.open(path).convert("RGB").crop((330, 150, 700, 450)), float), shown
    return shown


@pytest.mark.long
def test_the_page(tmp_path):
    pytest.importorskip("viser", reason="the optional package viser is not installed")
    driver = pytest.importorskip("playwright.sync_api", reason="playwright, which drives the browser, is not installed")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium is installed")
    (tmp_path / "scene.xml").write_text(SCENE)
    command = [sys.executable, "-m", "mi_diffind.commands.cli", "view", "scene.xml", "--port", "0"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, bufsize=1
    )
    try:
        url = re.search(r"http://127\.0\.0\.1:\d+", process.stdout.readline())[0]
        with (
            driver.sync_playwright() as playwright,
            playwright.chromium.launch(executable_path=program, args=OPTIONS) as browser,
        ):
            page, complaints = browser.new_page(viewport={"width": 1100, "height": 620}), []
            page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
            page.on("pageerror", lambda error: complaints.append(str(error)))
            page.goto(url)
            first = picture(page, tmp_path / "first.png")
            assert first.std() > 5  # a cube before its surroundings
            wait_for(page, r"error \d+\.\d dB against exact")

            page.mouse.move(450, 320)  # the camera follows the mouse
            page.mouse.down()
            page.mouse.move(540, 355, steps=12)
            page.mouse.up()
            moved = picture(page, tmp_path / "moved.png")
            assert np.abs(moved - first).mean() > 3
            page.get_by_role("button", name="first view").click()
            back = picture(page, tmp_path / "back.png")
            assert np.abs(back - first).mean() < np.abs(moved - first).mean() / 4  # noise differs

            page.locator("xpath=//label[normalize-space()='find']/following::input").first.fill("paint.metallic")
            wait_for(page, "metallic")
            slider = page.locator("xpath=//label[normalize-space()='metallic']/following::*[@role='slider']").first
            slider.focus()
            slider.press("End")
            assert np.abs(picture(page, tmp_path / "changed.png") - first).mean() > 3
            assert not complaints, complaints
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=60)
        assert process.returncode == 0 and "Traceback" not in output, output
    finally:
        process.kill()
