"""The picture of the live page: a demonstration is started, left to run for a while, and photographed in a browser.

    python training/picture_page.py --out docs/page.png

Needs Chromium, and Playwright, which is in the extra `dev`. `--view map` and `--dark` show the others.
"""

from __future__ import annotations

import argparse
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
SECONDS = 17  # until the newest 30 parts, by which parts an hour are counted, came at the speed of the demonstration
PATIENT = 120_000  # ms until the model answers


@contextmanager
def demonstration(seed: int) -> Iterator[str]:
    """Run `dengine serve --demo`; gives its address."""
    command = [sys.executable, "-m", "dengine", "serve", "--demo", "--port", "0", "--speed", "2", "--seed", str(seed)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        found = re.search(r"http://[\d.:]+", process.stdout.readline())
        if found is None:
            raise SystemExit("The demonstration did not start; what it said is above.")
        yield found.group()
        process.send_signal(signal.SIGINT)
        process.communicate()


def photograph(url: str, out: Path, width: int, height: int, dark: bool) -> None:
    """Wait until a model answers, then for the next decision that it is certain of, and take the picture."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(FLAGS))
        size = {"width": width, "height": height}
        context = browser.new_context(viewport=size, locale="en", color_scheme="dark" if dark else "light")
        page = context.new_page()
        page.set_default_timeout(PATIENT)
        page.goto(url)
        page.wait_for_selector("#mode.decides")
        if page.locator("section.decision").count():
            page.wait_for_timeout(1000 * SECONDS)
            page.wait_for_selector("section.decision.accept")
        page.screenshot(path=out)
        browser.close()


def main() -> None:
    """Parse, start, photograph, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("page.png"), help="the picture to write")
    parser.add_argument("--view", choices=("", "how", "map", "history", "acts"), default="", help="which view; the first")
    parser.add_argument("--width", type=int, default=1280, help="of the browser's window, in pixels")
    parser.add_argument("--height", type=int, default=720, help="of it")
    parser.add_argument("--dark", action="store_true", help="as on a device that is set to dark")
    parser.add_argument("--seed", type=int, default=0, help="of the parts' order")
    args = parser.parse_args()
    with demonstration(args.seed) as url:
        photograph(f"{url}/{args.view}", args.out, args.width, args.height, args.dark)
    print(f"Wrote {args.out}.")


if __name__ == "__main__":
    main()
