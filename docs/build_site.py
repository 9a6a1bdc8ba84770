"""Build the documentation site: `python docs/build_site.py build/docs`, or `make docs`."""

from __future__ import annotations

import runpy
import shutil
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from sphinx.cmd.build import main as sphinx

DOCS = Path(__file__).parent


def build(output: Path) -> int:
    """Write the site into `output`; a warning is an error.

    Returns:
        Sphinx's exit code.
    """
    pages: dict[str, str] = runpy.run_path(str(DOCS / "conf.py"))["PAGES"]
    with TemporaryDirectory() as folder:
        source = Path(folder, "source")
        shutil.copytree(DOCS, source)
        for page, file in pages.items():
            shutil.copyfile(DOCS.parent / file, source / f"{page}.md")
        places = ["-d", str(Path(folder, "doctrees")), str(source), str(output)]
        return sphinx(["-q", "-W", "-c", str(DOCS), *places])


if __name__ == "__main__":
    sys.exit(build(Path(sys.argv[1])))
