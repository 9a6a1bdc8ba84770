"""A page in headless Chromium, controlled through its DevTools protocol.

Screenshots are written to the folder of the variable MUSIC_RLLIB_PICTURES, such as docs/img.
"""

from __future__ import annotations

import asyncio
import base64
import json
import os
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.request import urlopen

import aiohttp

PATIENCE = 180.0


class Page:
    """One tab. Use it with `async with`."""

    def __init__(self, program: Path, folder: Path, width: int = 1500, height: int = 1000) -> None:
        self._folder = folder
        self._command = [
            str(program),
            *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync"),
            *("--disable-background-networking", "--disable-component-update"),
            *("--hide-scrollbars", "--remote-debugging-port=0", "--remote-allow-origins=*"),
            f"--user-data-dir={folder / 'profile'}",
            f"--window-size={width},{height}",
            "about:blank",
        ]
        self.errors: list[str] = []
        """Errors that the page logged or did not catch."""
        self.requests: list[str] = []
        """Requests to a server."""
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._number = 0

    async def __aenter__(self) -> Self:
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        port = await self._port()
        pages = json.load(urlopen(f"http://127.0.0.1:{port}/json"))
        address = next(p["webSocketDebuggerUrl"] for p in pages if p["type"] == "page")
        self._session = aiohttp.ClientSession()
        self._socket = await self._session.ws_connect(address, max_msg_size=0)
        self._listening = asyncio.create_task(self._listen())
        for domain in ("Page", "Runtime", "Log", "Network"):
            await self._send(f"{domain}.enable")
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._listening.cancel()
        await self._socket.close()
        await self._session.close()
        self._process.terminate()
        self._process.wait(30)

    async def _port(self) -> int:
        file = self._folder / "profile" / "DevToolsActivePort"
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            if file.exists() and (text := file.read_text()):
                return int(text.splitlines()[0])
            await asyncio.sleep(0.1)
        raise TimeoutError("Chromium did not start")

    async def _listen(self) -> None:
        async for message in self._socket:
            event = json.loads(message.data)
            if "id" in event:
                self._answers.pop(event["id"]).set_result(event)
            elif event["method"] == "Runtime.exceptionThrown":
                self.errors.append(str(event["params"]["exceptionDetails"]))
            elif event["method"] == "Network.requestWillBeSent":
                url = event["params"]["request"]["url"]
                self.requests += [] if url.startswith(("file:", "data:", "about:")) else [url]
            elif event["method"] == "Log.entryAdded":
                entry = event["params"]["entry"]
                if entry["level"] == "error":
                    self.errors.append(f"{entry['text']} {entry.get('url', '')}")

    async def _send(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        answer = asyncio.get_running_loop().create_future()
        self._answers[self._number] = answer
        await self._socket.send_json({"id": self._number, "method": method, "params": params})
        reply = await asyncio.wait_for(answer, PATIENCE)
        assert "error" not in reply, reply
        return reply.get("result", {})  # type: ignore[no-any-return]

    async def go(self, url: str) -> None:
        """Open `url` again, even if only its fragment (after #) changed."""
        await self._send("Page.navigate", url="about:blank")
        await self._send("Page.navigate", url=url)

    async def view(
        self, width: int, height: int, *, dark: bool = False, medium: str = "screen"
    ) -> None:
        """Set the size of the window, which may be smaller than Chromium's smallest window."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        await self._send("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        await self._send("Emulation.setEmulatedMedia", media=medium, features=[scheme])

    async def without_script(self, *, off: bool = True) -> None:
        """Whether pages may run scripts; applies to the next page."""
        await self._send("Emulation.setScriptExecutionDisabled", value=off)

    async def point_at(self, x: float, y: float) -> None:
        """Move the pointer."""
        await self._send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    async def click(self, label: str, kind: str = "button") -> None:
        """Click on the first element of this kind with `label` in its text."""
        found = (
            f"[...document.querySelectorAll({kind!r})].find(e => e.innerText.includes({label!r}))"
        )
        x, y = await self.evaluate(
            f"(({{x, y, width, height}}) => [x + width / 2, y + height / 2])"
            f"({found}.getBoundingClientRect())"
        )
        where = {"x": x, "y": y, "button": "left", "clickCount": 1}
        for moment in ("mousePressed", "mouseReleased"):
            await self._send("Input.dispatchMouseEvent", type=moment, **where)

    async def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression, or of its promise."""
        options = {"returnByValue": True, "awaitPromise": True}
        reply = await self._send("Runtime.evaluate", expression=script, **options)
        return reply["result"].get("value")

    async def press(self, key: str) -> None:
        """Press and release a key, such as `Tab`."""
        codes = {"Tab": 9, "Enter": 13, "Space": 32}
        named = {"key": " " if key == "Space" else key, "code": key}
        for kind in ("keyDown", "keyUp"):
            code = codes[key]
            await self._send(
                "Input.dispatchKeyEvent", type=kind, windowsVirtualKeyCode=code, **named
            )

    async def text(self) -> str:
        """The visible text of the page."""
        return str(await self.evaluate("document.body ? document.body.innerText : ''"))

    async def wait_for(self, *words: str) -> str:
        """The page's text as soon as it has all of `words`."""
        deadline, text = time.monotonic() + PATIENCE, ""
        while time.monotonic() < deadline:
            text = await self.text()
            if all(word in text for word in words):
                return text
            await asyncio.sleep(0.3)
        missing = [word for word in words if word not in text]
        raise AssertionError(f"no {missing} in:\n{text[:3000]}\nerrors: {self.errors}")

    async def picture(self, name: str) -> None:
        """Save a screenshot of the window as the PNG `name`, if a folder is given for it."""
        if not (folder := os.environ.get("MUSIC_RLLIB_PICTURES")):
            return
        await asyncio.sleep(0.5)
        reply = await self._send("Page.captureScreenshot", format="png")
        path = Path(folder) / name
        path.write_bytes(base64.b64decode(reply["data"]))
