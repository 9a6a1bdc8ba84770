"""The dashboards, with a sweep that Prometheus scrapes."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.parse import urlencode
from urllib.request import urlopen

import pytest
import yaml

from music_rllib.sweep.listeners.prometheus import GAUGES, TARGETS
from tests.ports import free_port

DASHBOARDS = Path(__file__).parents[3] / "dashboards"
PATIENCE = 240.0


def dashboard() -> dict[str, Any]:
    path = DASHBOARDS / "grafana" / "dashboards" / "sweeps.json"
    return json.loads(path.read_text())  # type: ignore[no-any-return]


def queries() -> dict[str, str]:
    """The query of each panel, with all values of Grafana's variables."""
    return {
        f"{panel['title']} {target['refId']}": re.sub(r"\$\w+", ".*", target["expr"])
        for panel in dashboard()["panels"]
        for target in panel["targets"]
    }


def variables() -> list[tuple[str, str]]:
    """(metric, label) of each variable."""
    found = [
        re.fullmatch(r"label_values\((\w+), (\w+)\)", variable["query"]["query"])
        for variable in dashboard()["templating"]["list"]
        if variable["type"] == "query"
    ]
    return [(match[1], match[2]) for match in found if match is not None]


def test_the_dashboard_shows_every_gauge_and_no_other() -> None:
    shown = {name for query in queries().values() for name in re.findall(r"ray_(\w+)", query)}
    # The number of updates is exported for other dashboards.
    assert shown | {"music_grad_updates"} == set(GAUGES)
    assert len(variables()) == 3


def test_the_provisioning_is_consistent() -> None:
    grafana = DASHBOARDS / "grafana"
    sources = yaml.safe_load((grafana / "provisioning/datasources/prometheus.yml").read_text())
    (source,) = sources["datasources"]
    panels = dashboard()["panels"]
    # The user can choose another data source; the provisioned one is the default.
    (chosen, *_) = dashboard()["templating"]["list"]
    assert (chosen["type"], chosen["query"]) == ("datasource", source["type"])
    assert chosen["current"]["value"] == source["uid"]
    uids = {panel["datasource"]["uid"] for panel in panels}
    uids |= {target["datasource"]["uid"] for panel in panels for target in panel["targets"]}
    assert uids == {f"${{{chosen['name']}}}"}
    assert all(panel["description"].endswith(".") for panel in panels)
    assert len({panel["id"] for panel in panels}) == len(panels)
    places = [panel["gridPos"] for panel in panels]
    for place in places:
        assert place["x"] + place["w"] <= 24
    (provider,) = yaml.safe_load((grafana / "provisioning/dashboards/music_rllib.yml").read_text())[
        "providers"
    ]
    assert provider["type"] == "file"


class Prometheus:
    """A server that scrapes the sweep with the repository's configuration."""

    def __init__(self, program: Path, folder: Path) -> None:
        self.address = f"127.0.0.1:{free_port()}"
        text = (DASHBOARDS / "prometheus.yml").read_text()
        config = yaml.safe_load(text)
        (job,) = config["scrape_configs"]
        (discovery,) = job["file_sd_configs"]
        assert f"../results/{TARGETS}/*.json" in discovery["files"]
        discovery["files"] = [str(folder / "results" / TARGETS / "*.json")]
        config["global"]["scrape_interval"] = discovery["refresh_interval"] = "1s"
        (folder / "prometheus.yml").write_text(yaml.safe_dump(config))
        self.log = folder / "prometheus.log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [
                    str(program),
                    f"--config.file={folder / 'prometheus.yml'}",
                    f"--storage.tsdb.path={folder / 'tsdb'}",
                    f"--web.listen-address={self.address}",
                ],
                stdout=log,
                stderr=log,
            )

    def ask(self, query: str) -> list[dict[str, Any]]:
        """The series of an instant query; empty while the server starts."""
        assert self.process.poll() is None, self.log.read_text()
        url = f"http://{self.address}/api/v1/query?{urlencode({'query': query})}"
        try:
            with urlopen(url, timeout=10) as answer:
                return json.load(answer)["data"]["result"]  # type: ignore[no-any-return]
        except (URLError, OSError):
            return []


@pytest.fixture
def prometheus(require_service: Callable[[str], Path], tmp_path: Path) -> Iterator[Prometheus]:
    server = Prometheus(require_service("prometheus"), tmp_path)
    yield server
    server.process.terminate()
    server.process.wait(30)


def test_every_query_returns_data_of_a_running_sweep(
    prometheus: Prometheus, sweep_program: Any, sweep_document: dict[str, Any]
) -> None:
    sweep_document["name"] = "watched"
    # The sweep is stopped when every query has returned data.
    sweep_document["stages"] = sweep_document["stages"][:1]
    sweep_document["defaults"]["env_steps"] = 2_000_000
    sweep_program.write(sweep_document)
    process = sweep_program.start()
    waiting = queries()
    seen: dict[str, list[dict[str, Any]]] = {}
    deadline = time.monotonic() + PATIENCE
    try:
        while waiting and time.monotonic() < deadline and process.poll() is None:
            for name, query in list(waiting.items()):
                if found := prometheus.ask(query):
                    seen[name] = found
                    del waiting[name]
            time.sleep(0.5)
        ended = process.poll()
        labels = {label for metric, label in variables() if prometheus.ask(f"{metric}")}
    finally:
        process.terminate()
        output, errors = process.communicate(timeout=120)
    assert ended is None, f"the sweep must not end early:\n{output}{errors}"
    assert process.returncode == 128 + signal.SIGTERM
    assert "continue with: python -m music_rllib.sweep run sweep.yaml" in output
    assert not waiting, f"no data for {list(waiting)}"
    assert labels == {"sweep", "task", "q"}
    (success,) = seen["Success rate by q and task A"]
    assert success["metric"] == {"q": "1", "stage": "pretrain", "task": "Point"}
    assert 0 <= float(success["value"][1]) <= 1
    targets = sweep_program.folder / "results" / TARGETS
    assert not list(targets.iterdir()), "a sweep that has ended is not scraped"
    states = {one["metric"]["state"]: one["value"][1] for one in seen["Runs by state A"]}
    assert states["started"] == "1"
    assert seen["Failed runs A"][0]["value"][1] == "0"
