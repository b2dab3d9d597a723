"""Syntax of the pages that Python-Markdown does not know: maths, equations and names.

The generator loads this module by its name, and uses it for pages and docstrings.
"""

import re
from typing import Any

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.preprocessors import Preprocessor


# Code in backquotes stays as it is, and is matched first for that reason.
MATHS = re.compile(
    r"(?P<code>(?P<ticks>`+)(?!`).+?(?<!`)(?P=ticks)(?!`))"
    r"|\$\$(?P<block>.+?)\$\$"
    r"|(?<![\\\w$])\$(?P<inline>[^\s$](?:[^$]*?[^\s$])?)\$(?![\d\w$])",
    re.DOTALL,
)
# A name of nhjax in backquotes, alone or called, that is not a link yet.
NAME = re.compile(r"(?<![`\[])`(?P<name>[A-Za-z_][\w./]*)(?:\([^`]*\))?`(?!`)")
# Lines such as `L = m/2 |v|² - V,`, and the beginnings of such lines.
END = re.compile(r"^[^`]* = [^`]*[,;]$")
START = re.compile(r"\s*\S[^`.:]{0,24} = ")
DOCTEST = re.compile(r"(?<!`pycon\n)^( *)>>> .*\n(?:.*\S.*\n)*", re.MULTILINE)


class Doctests(Preprocessor):
    """Fence the examples with prompts, which are indented in docstrings."""

    def run(self, lines: list[str]) -> list[str]:
        """Fence the lines from a prompt to the next empty line, outside of fences."""
        text = "\n".join([*lines, ""])
        return DOCTEST.sub(r"\1```pycon\n\g<0>\1```\n", text).split("\n")


class Equations(Preprocessor):
    """Keep the line breaks between equations in plain text."""

    def run(self, lines: list[str]) -> list[str]:
        """Break a line that ends an equation if the next line begins another one."""
        following = [*lines[1:], ""]
        return [
            f"{line}  " if END.search(line) and START.match(after) else line
            for line, after in zip(lines, following, strict=True)
        ]


class Maths(Preprocessor):
    """Turn formulas into MathML, which browsers draw without scripts and fonts."""

    def run(self, lines: list[str]) -> list[str]:
        """Replace each formula by a placeholder for its MathML."""
        return MATHS.sub(self._formula, "\n".join(lines)).split("\n")

    def _formula(self, match: re.Match[str]) -> str:
        if match["code"]:
            return match[0]
        display = "block" if match["block"] else "inline"
        maths = convert(match["block"] or match["inline"], display=display)
        # Browsers scale a dot over a letter, so that it is too small to be seen.
        maths = maths.replace("<mo>&#x002D9;</mo>", '<mo class="dot">&#x002D9;</mo>')
        if match["block"]:
            maths = f'<span class="formula" tabindex="0">{maths}</span>'
        return self.md.htmlStash.store(maths)


class Names(Preprocessor):
    """Turn public names in backquotes into links to their pages."""

    def __init__(self, md: Markdown, names: dict[str, str]):
        super().__init__(md)
        self.names = names

    def run(self, lines: list[str]) -> list[str]:
        """Link the names in all lines that are not headings."""
        return [
            line if line.startswith("#") else NAME.sub(self._link, line)
            for line in lines
        ]

    def _link(self, match: re.Match[str]) -> str:
        target = self.names.get(match["name"])
        return f"[{match[0]}][{target}]" if target else match[0]


class SiteExtension(Extension):
    """All of the above; the option `names` maps names to the paths of their objects."""

    def __init__(self, **kwargs: Any):
        self.config = {"names": [{}, "paths of objects by the names for them"]}
        super().__init__(**kwargs)

    def extendMarkdown(self, md: Markdown) -> None:
        """Register the parts, the first before and the others after fenced blocks."""
        md.preprocessors.register(Doctests(md), "doctests", 40)
        md.preprocessors.register(Maths(md), "maths", 24)
        md.preprocessors.register(Equations(md), "equations", 22)
        names = self.getConfig("names")
        md.preprocessors.register(Names(md, names), "names", 23)


def makeExtension(**kwargs: Any) -> SiteExtension:
    """Create the extension; Python-Markdown calls this function."""
    return SiteExtension(**kwargs)
