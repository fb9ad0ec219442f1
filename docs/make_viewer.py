"""
Take the picture of the viewer's page, ``docs/viewer.jpg``, in headless Chromium (needs viser and playwright):

    python docs/make_viewer.py
"""

import io
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parents[1]

OPTIONS = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-background-networking"]

#: Samples a pixel that are waited for.
SAMPLES = "96"


def main() -> None:
    scene = str(ROOT / "scenes" / "solids.xml")
    command = [sys.executable, "-m", "mi_diffind.commands.cli", "view", scene, "--port", "0", "--width", "640"]
    server = subprocess.Popen([*command, "--spp", SAMPLES], stdout=subprocess.PIPE, text=True)
    try:
        url = re.search(r"http://\S+", server.stdout.readline())[0]
        with tempfile.TemporaryDirectory() as profile, sync_playwright() as playwright:
            program = shutil.which("chromium") or shutil.which("google-chrome")
            browser = playwright.chromium.launch_persistent_context(
                profile, executable_path=program, viewport={"width": 1180, "height": 620}, args=OPTIONS
            )
            page = browser.new_page()
            page.set_default_timeout(600_000)
            page.goto(url)
            page.locator("xpath=//label[normalize-space()='find']/following::input").first.fill("clay")
            while not re.search(rf"samples\s+{SAMPLES} of", page.inner_text("body")):
                time.sleep(0.5)
            notice = page.locator(".mantine-Notification-closeButton")  # the browser has no GPU
            for _ in range(notice.count()):
                notice.first.click()
            time.sleep(2)
            image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
            browser.close()
    finally:
        server.terminate()
        server.wait()
    image.save(ROOT / "docs" / "viewer.jpg", quality=82, optimize=True)


if __name__ == "__main__":
    main()
