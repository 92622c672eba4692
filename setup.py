"""What packages need beyond pyproject.toml: a page whose addresses and links work, and the links between folders in an sdist.

`[tool.jfrnn] repository` in pyproject.toml is the one place that says where the project lives, as https://github.com/owner/jfrnn:
files are then looked for below `blob/main`, pictures below `raw/main`. While it is empty, links to files become their text and the
path of the file in a checkout, and pictures what they show.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup
from setuptools.command.sdist import sdist

ROOT = Path(__file__).parent
CHECKOUT = re.compile(r"<!-- checkout -->.*?<!-- end checkout -->\n*", re.DOTALL)  # of no use to whoever has a wheel
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?://|#)([^)]+)\)")


def read_repository() -> str:
    """Return where the project lives, without a slash at its end; empty where nobody has said."""
    with (ROOT / "pyproject.toml").open("rb") as stream:
        return tomllib.load(stream)["tool"]["jfrnn"]["repository"].rstrip("/")


def rewrite_links(text: str, repository: str) -> str:
    """Return a README without links that lead nowhere outside of the repository, and without what a checkout alone can do."""

    def replace(link: re.Match[str]) -> str:
        picture, shown, path = link.groups()
        if not repository:
            place = "" if path in shown else f" (`{path}`)"
            return f"*{shown}*" if picture else f"{shown}{place}"
        return f"{picture}[{shown}]({repository}/{'raw' if picture else 'blob'}/main/{path})"

    return LINK.sub(replace, CHECKOUT.sub("", text))


def list_addresses(repository: str) -> dict[str, str]:
    """Return the addresses of the project by name."""
    if not repository:
        return {}
    pages = {"Documentation": "docs/start.md", "Changelog": "CHANGELOG.md"}
    return {"Homepage": repository} | {name: f"{repository}/blob/main/{path}" for name, path in pages.items()}


class SdistWithLinks(sdist):
    """A source distribution that holds jfrnn/cases and jfrnn/kernels as links, as a checkout does: its tests run from it."""

    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        """Copy the files, then add the links, which setuptools leaves out."""
        super().make_release_tree(base_dir, files)
        for name in ("cases", "kernels"):
            Path(base_dir, "jfrnn", name).symlink_to(Path("..", name))


home = read_repository()
setup(
    cmdclass={"sdist": SdistWithLinks},
    long_description=rewrite_links((ROOT / "README.md").read_text(encoding="utf-8"), home),
    long_description_content_type="text/markdown",
    project_urls=list_addresses(home),
)
