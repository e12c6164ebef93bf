"""What mkdocs has to be told of these pages: files from outside of docs/, folded parts, equations without a script."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files
from pymdownx.slugs import slugify

OUTSIDE = {
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "MODEL_CARD.md": "g3r/checkpoints/weights/MODEL_CARD.md",
    "notebook.md": "examples/reconstruct.ipynb",
    "LICENSE.txt": "LICENSE",
}
"""Files of the repository that pages point at: their names on the site, and where they are."""

EQUATION = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', flags=re.DOTALL)


def on_config(config: Any) -> Any:
    """Name anchors as GitHub does, so that links are right in both places."""
    config.mdx_configs["toc"]["slugify"] = slugify(case="lower")
    return config


def on_files(files: Files, config: Any) -> Files:
    """Take the files from outside into the site."""
    root = Path(config.config_file_path).parent
    for name, path in OUTSIDE.items():
        source = root / path
        if source.suffix == ".ipynb":
            files.append(File.generated(config, name, content=_notebook(source)))
        else:
            files.append(File.generated(config, name, abs_src_path=str(source)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Lead links to where the files are on the site, and let tables be tables where they are folded away."""
    markdown = markdown.replace("<details>", '<details markdown="1">')
    for name, path in OUTSIDE.items():
        markdown = re.sub(rf"\]\((?:\.\./)+{re.escape(path)}", f"]({name}", markdown)
    if page.file.src_uri in OUTSIDE:
        markdown = re.sub(r"\]\((?:\.\./)*docs/", "](", markdown)
        markdown = re.sub(r"\]\((?:\.\./)+CHANGELOG", "](CHANGELOG", markdown)
    return markdown


def on_page_content(content: str, page: Any, config: Any, files: Files) -> str:
    """Write equations as MathML, which browsers show by themselves."""
    return EQUATION.sub(_mathml, content)


def _notebook(path: Path) -> str:
    """The cells of a notebook as a page."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = [(cell["cell_type"], "".join(cell["source"])) for cell in cells]
    found = "\n\n".join(f"```python\n{text}\n```" if kind == "code" else text for kind, text in texts)
    return f"{found}\n\n*Without its outputs; to see them, run `examples/{path.name}`.*"


def _mathml(found: re.Match[str]) -> str:
    text = html.unescape(found[3]).strip()
    if found[2] == "(":
        return convert(text)
    return f'<div class="equation">{convert(text, display="block")}</div>'
