"""The dashboards; test_sweep_local.py has a sweep that Prometheus scrapes."""

from __future__ import annotations

import json
import re
import subprocess
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
DASHBOARD_SECONDS = 240.0


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
    assert shown == set(GAUGES)
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

    def __init__(self, program: Path, folder: Path, sweeps: Path) -> None:
        self.address = f"127.0.0.1:{free_port()}"
        text = (DASHBOARDS / "prometheus.yml").read_text()
        config = yaml.safe_load(text)
        (job,) = config["scrape_configs"]
        (discovery,) = job["file_sd_configs"]
        assert f"../results/{TARGETS}/*.json" in discovery["files"]
        discovery["files"] = [str(sweeps / "results" / TARGETS / "*.json")]
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
def prometheus(
    require_service: Callable[[str], Path], tmp_path: Path
) -> Iterator[Callable[[Path], Prometheus]]:
    """Start a server for the sweeps in a folder."""
    program, servers = require_service("prometheus"), []

    def start(sweeps: Path) -> Prometheus:
        servers.append(Prometheus(program, tmp_path, sweeps))
        return servers[-1]

    yield start
    for server in servers:
        server.process.terminate()
        server.process.wait(30)
