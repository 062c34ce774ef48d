"""`jaxvr.explore` in JupyterLab, driven in a browser: the picture is dragged, then a control point,
then buttons are pressed.

    python -m experiments.explorer_in_browser [--out notebooks] [--dark] [--window FILE]

starts JupyterLab on this machine only, opens a notebook in Chromium without a display, runs it and
takes screenshots before, after a drag of the picture and after a drag of a control point. Then it
presses every button for a view and for the axis that is up. Prints what part of the picture each
changed, what the lines of the widget say, and how long coarse and exact frames took; exit status 1
if something changed nothing or the lines do not say where the view is. Needs jupyterlab, anywidget
and selenium, Chromium and its driver.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import io
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
CELLS = ("import jaxvr", "explorer = jaxvr.explore(jaxvr.datasets.heat_sink())\nexplorer")
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync "
    "--window-size=1100,1250"
).split()
VIEWS = ("front", "right", "back", "left", "top", "bottom")
UPS = ("x", "y", "z", "−x", "−y", "−z")
WAIT = 120.0  # seconds for a first picture, with compiling


def notebook(cells: Any = CELLS) -> str:
    """The text of a notebook file with these cells of code."""
    code = [
        {
            "cell_type": "code",
            "id": f"cell-{k}",
            "source": source,
            "metadata": {},
            "outputs": [],
            "execution_count": None,
        }
        for k, source in enumerate(cells)
    ]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    about = {"metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    return json.dumps({"cells": code} | about)


@contextlib.contextmanager
def jupyterlab(folder: Path, dark: bool):
    """Runs JupyterLab in a folder; gives its address."""
    settings = folder / "settings" / "@jupyterlab" / "apputils-extension"
    settings.mkdir(parents=True)
    theme = {"theme": "JupyterLab Dark" if dark else "JupyterLab Light"}
    (settings / "themes.jupyterlab-settings").write_text(json.dumps(theme))
    quiet = {"fetchNews": "false", "checkForUpdates": False}
    (settings / "notification.jupyterlab-settings").write_text(json.dumps(quiet))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = ("config", "data", "runtime")
    dirs = {f"JUPYTER_{name.upper()}_DIR": str(folder / name) for name in own}
    dirs |= {
        "JUPYTERLAB_SETTINGS_DIR": str(folder / "settings"),
        "JUPYTERLAB_WORKSPACES_DIR": str(folder / "workspaces"),
        "IPYTHONDIR": str(folder / "ipython"),
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root"]
    command += ["--ip=127.0.0.1", f"--port={port}", "--expose-app-in-browser"]
    command += ["--IdentityProvider.token=", f"--ServerApp.root_dir={folder}"]
    address = f"http://127.0.0.1:{port}"
    with open(folder / "server.log", "w") as log:
        server = subprocess.Popen(command, env=os.environ | dirs, stdout=log, stderr=log)
        try:
            _until(lambda: _answers(address + "/api"), 60, "JupyterLab")
            yield address
        finally:
            server.terminate()
            server.wait(20)


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=2):
            return True
    except OSError:
        return False


def _until(done: Any, seconds: float, what: str) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := done():
            return found
        time.sleep(0.1)
    raise TimeoutError(f"Waited {seconds:g} s for {what}.")


class Page:
    """The widget in the browser."""

    def __init__(self, driver: Any):
        self.driver = driver
        self.seen: list[str] = []

    def status(self) -> str:
        script = "return document.querySelector('.jaxvr-explorer .quality')?.textContent ?? ''"
        text = self.driver.execute_script(script)
        if text and (not self.seen or self.seen[-1] != text):
            self.seen.append(text)
        return text

    def exact(self) -> np.ndarray:
        """Waits until the exact picture is there, and returns it (H, W, 4) in bytes."""
        _until(lambda: self.status().startswith("exact"), WAIT, "the exact picture")
        time.sleep(1.0)  # for a frame that is on its way
        _until(lambda: self.status().startswith("exact"), WAIT, "the exact picture")
        script = "return document.querySelector('.jaxvr-explorer canvas').toDataURL('image/png')"
        data = self.driver.execute_script(script).split(",", 1)[1]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))

    def quicken(self) -> None:
        """Rotates there and back by keys until pictures are coarse: their code is compiled in the
        background at first."""
        canvas = self.find("canvas")[0]
        end = time.monotonic() + WAIT
        while not self.status().startswith("coarse") and time.monotonic() < end:
            canvas.send_keys("\ue012\ue014")  # left and right
            time.sleep(0.1)
        self.exact()

    def drag(self, element: Any, steps: Any) -> None:
        """From the element's middle by steps (dx, dy), with the state noted after each."""
        from selenium.webdriver import ActionChains  # pyright: ignore[reportMissingImports]

        ActionChains(self.driver, duration=20).move_to_element(element).click_and_hold().perform()
        for dx, dy in steps:
            ActionChains(self.driver, duration=20).move_by_offset(dx, dy).perform()
            time.sleep(0.03)
            self.status()
        ActionChains(self.driver).release().perform()

    def find(self, selector: str) -> Any:
        return self.driver.find_elements("css selector", f".jaxvr-explorer {selector}")

    def press(self, text: str) -> tuple[np.ndarray, str, list[str]]:
        """Presses the button with that text: the exact picture after it, the line that says where
        it is seen from, and the buttons that are shown as pressed."""
        (button,) = (b for b in self.find("button[aria-pressed]") if b.text == text)
        button.click()
        picture = self.exact()
        pressed = [b.text for b in self.find("button[aria-pressed=true]")]
        return picture, self.lines()[0], pressed

    def lines(self) -> list[str]:
        """What the widget says of its view, and of its transfer function."""
        return [self.find(".row span")[0].text, self.find(".told")[0].text]

    def ready(self) -> bool:
        """Whether the kernel is there; answers JupyterLab's question which one to take.

        The shell has a current widget, whose kernel that is, once something in it has the focus: a
        click on the first cell gives it that.
        """
        buttons = self.driver.find_elements("css selector", ".jp-Dialog .jp-mod-accept")
        for button in buttons:
            button.click()
        cells = self.driver.find_elements("css selector", ".jp-Notebook .jp-Cell .cm-content")
        current = "return Boolean(window.jupyterapp?.shell.currentWidget)"
        if cells and not buttons and not self.driver.execute_script(current):
            cells[0].click()
        script = "return window.jupyterapp?.shell.currentWidget?.sessionContext?.session?.kernel"
        return self.driver.execute_script(script + "?.connectionStatus === 'connected'")

    def save(self, path: Path) -> None:
        root = self.driver.find_element("css selector", ".jaxvr-explorer")
        path.write_bytes(root.screenshot_as_png)

    def milliseconds(self, kind: str) -> list[int]:
        """Of the frames whose status was seen."""
        found = (re.fullmatch(rf"{kind}[^·]*· (\d+) ms", text) for text in self.seen)
        return [int(m[1]) for m in found if m]


def run(
    out: Path,
    chromium: str,
    driver_path: str,
    *,
    dark: bool = False,
    window: Path | None = None,
) -> dict[str, Any]:
    """Drives the widget; writes explorer_before.png, _after.png and _transfer.png to `out`, and
    the whole window at the end to `window`."""
    from selenium import webdriver  # pyright: ignore[reportMissingImports]
    from selenium.webdriver.chrome.service import Service  # pyright: ignore[reportMissingImports]

    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / "explore.ipynb").write_text(notebook())
        address = stack.enter_context(jupyterlab(folder, dark))
        options = webdriver.ChromeOptions()
        options.binary_location = chromium
        for flag in (*FLAGS, f"--user-data-dir={folder / 'browser'}"):
            options.add_argument(flag)
        driver = webdriver.Chrome(options=options, service=Service(driver_path))
        stack.callback(driver.quit)
        driver.get(f"{address}/lab/tree/explore.ipynb")
        page = Page(driver)
        _until(page.ready, WAIT, "the kernel")
        driver.execute_script("window.jupyterapp.commands.execute('application:toggle-left-area')")
        driver.execute_script("window.jupyterapp.commands.execute('notebook:run-all-cells')")
        _until(lambda: page.find("canvas"), WAIT, "the widget")
        start = time.monotonic()
        before = page.exact()
        seconds = time.monotonic() - start
        driver.execute_script("arguments[0].scrollIntoView()", page.find("canvas")[0])
        page.save(out / "explorer_before.png")
        lines = page.lines()
        page.quicken()
        page.drag(page.find("canvas")[0], [(8, 3)] * 25)
        after = page.exact()
        page.save(out / "explorer_after.png")
        page.drag(page.find(".point")[2], [(0, -2)] * 25)
        recolored = page.exact()
        page.save(out / "explorer_transfer.png")
        edited = page.lines()[1]
        buttons, last = {}, recolored
        for text in (*VIEWS, *UPS):
            picture, line, pressed = page.press(text)
            buttons[text] = {"line": line, "pressed": pressed, "changed": changed(last, picture)}
            last = picture
        if window is not None:
            driver.save_screenshot(str(window))
        errors = [e["message"] for e in driver.get_log("browser") if e["level"] == "SEVERE"]
    return {
        "seconds_to_first_exact": round(seconds, 2),
        "changed_by_camera": changed(before, after),
        "changed_by_transfer": changed(after, recolored),
        "lines": lines,
        "line_after_edit": edited,
        "buttons": buttons,
        "coarse_ms": page.milliseconds("coarse"),
        "exact_ms": page.milliseconds("exact"),
        "statuses": page.seen,
        "browser_errors": errors,
    }


def changed(a: np.ndarray, b: np.ndarray) -> float:
    """Part of the pixels that differ by more than two in some channel."""
    return float((np.abs(a.astype(int) - b.astype(int)).max(-1) > 2).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "notebooks")
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--driver", default="/usr/bin/chromedriver")
    parser.add_argument("--dark", action="store_true", help="in JupyterLab's dark theme")
    parser.add_argument("--window", type=Path, help="where to save the whole window, as PNG")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    report = run(
        arguments.out,
        arguments.chromium,
        arguments.driver,
        dark=arguments.dark,
        window=arguments.window,
    )
    print(json.dumps(report, indent=1, ensure_ascii=False))
    if min(report["changed_by_camera"], report["changed_by_transfer"]) < 0.01:
        sys.exit("A drag did not change the picture.")
    if wrong := wrongs(report):
        sys.exit("; ".join(wrong))


def wrongs(report: dict[str, Any]) -> list[str]:
    """What the widget does not say or does not do, of the report that `run` gives."""
    found = []
    view, told = report["lines"]
    if " up, which shows most" not in view:
        found.append(f"The axis that was chosen is not told: {view!r}.")
    if "quantiles" not in told or report["line_after_edit"]:
        found.append(f"What the transfer function spans is not told: {told!r}.")
    for text, seen in report["buttons"].items():
        from_axis = text not in VIEWS or " from " in seen["line"]
        up = text not in UPS or seen["line"].startswith(f"{text.replace('−', '-')} up")
        if not (text in seen["pressed"] and from_axis and up):
            found.append(f"Button {text}: the widget says {seen['line']!r}, {seen['pressed']}.")
        # "x" may be up already, and the heat sink is the same from above and from below.
        if text not in (UPS[0], "bottom") and not seen["changed"] > 0:
            found.append(f"Button {text} did not change the picture.")
    return found


if __name__ == "__main__":
    main()
