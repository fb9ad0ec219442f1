"""
Take the picture of the viewer's page, ``docs/viewer.jpg``, in headless Chromium (needs viser and playwright):

    python docs/make_viewer.py
"""

import argparse
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", default=str(ROOT / "scenes" / "solids.xml"))
    parser.add_argument("--find", default="clay", help="parameters to show")
    parser.add_argument("--spp", default="256")
    parser.add_argument("-o", "--output", default=str(ROOT / "docs" / "viewer.jpg"))
    arguments = parser.parse_args()
    command = [
        sys.executable,
        "-m",
        "mi_diffind.commands.cli",
        "view",
        arguments.scene,
        "--port",
        "0",
        "--width",
        "640",
    ]
    server = subprocess.Popen([*command, "--spp", arguments.spp], stdout=subprocess.PIPE, text=True)
    try:
        url = re.search(r"http://\S+", server.stdout.readline())[0]
        with tempfile.TemporaryDirectory() as profile, sync_playwright() as playwright:
            program = shutil.which("chromium") or shutil.which("google-chrome")
            browser = playwright.chromium.launch_persistent_context(
                profile, executable_path=program, viewport={"width": 1180, "height": 620}, args=OPTIONS
            )
            page = browser.new_page()
            page.goto(url)
            page.locator("xpath=//label[normalize-space()='find']/following::input").first.fill(arguments.find)
            page.get_by_text("Software WebGL").locator("xpath=following::button | preceding::button").last.wait_for()
            notice = page.locator(".mantine-Notification-closeButton")
            for _ in range(notice.count()):
                notice.first.click()
            while not re.search(rf"samples\s+{arguments.spp} of", page.inner_text("body")):
                time.sleep(0.5)
            time.sleep(2)
            image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
            browser.close()
    finally:
        server.terminate()
        server.wait()
    image.save(arguments.output, quality=82, optimize=True)
    print(f"{arguments.output}: {Path(arguments.output).stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
