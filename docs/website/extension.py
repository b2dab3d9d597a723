"""What the pages write and Python-Markdown does not know: doctests, maths, names.

The generator loads this module by its name and hands it to the pages and to the
docstrings alike.
"""

import re
from typing import Any

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.preprocessors import Preprocessor


# What stands in backquotes is left as it is, and matched first for that reason.
MATHS = re.compile(
    r"(?P<code>(?P<ticks>`+)(?!`).+?(?<!`)(?P=ticks)(?!`))"
    r"|\$\$(?P<block>.+?)\$\$"
    r"|(?<![\\\w$])\$(?P<inline>[^\s$](?:[^$]*?[^\s$])?)\$(?![\d\w$])",
    re.DOTALL,
)
# A name of nhjax in backquotes, alone or called, that is no link yet.
NAME = re.compile(r"(?<![`\[])`(?P<name>[A-Za-z_][\w./]*)(?:\([^`]*\))?`(?!`)")
# Lines such as `L = m/2 |v|² - V,`, and those that begin so.
END = re.compile(r"^[^`]* = [^`]*[,;]$")
START = re.compile(r"\s*\S[^`.:]{0,24} = ")
PROMPT = re.compile(r"( *)>>> ")


class Doctests(Preprocessor):
    """Examples with prompts, which docstrings indent, become fenced blocks."""

    def run(self, lines: list[str]) -> list[str]:
        """Fence each run of lines from a prompt to the next empty line."""
        fenced, indent, is_fenced = [], None, False
        for line in lines:
            is_fenced ^= line.lstrip().startswith("```")
            prompt = PROMPT.match(line)
            if indent is None and prompt and not is_fenced:
                indent = prompt[1]
                fenced.append(f"{indent}```pycon")
            elif indent is not None and not line.strip():
                fenced.append(f"{indent}```")
                indent = None
            fenced.append(line)
        return fenced if indent is None else [*fenced, f"{indent}```"]


class Equations(Preprocessor):
    """Equations in plain text that stand in lines of their own keep these lines."""

    def run(self, lines: list[str]) -> list[str]:
        """Break a line that ends an equation where the next one begins another."""
        following = [*lines[1:], ""]
        return [
            f"{line}  " if END.search(line) and START.match(after) else line
            for line, after in zip(lines, following, strict=True)
        ]


class Maths(Preprocessor):
    """Formulas become MathML, which browsers draw without scripts or fonts of ours."""

    def run(self, lines: list[str]) -> list[str]:
        """Put a placeholder for the MathML in the place of each formula."""
        return MATHS.sub(self._formula, "\n".join(lines)).split("\n")

    def _formula(self, match: re.Match[str]) -> str:
        if match["code"]:
            return match[0]
        display = "block" if match["block"] else "inline"
        maths = convert(match["block"] or match["inline"], display=display)
        # A dot over a letter is too small to be seen, as browsers scale it.
        maths = maths.replace("<mo>&#x002D9;</mo>", '<mo class="dot">&#x002D9;</mo>')
        if match["block"]:
            maths = f'<span class="formula" tabindex="0">{maths}</span>'
        return self.md.htmlStash.store(maths)


class Names(Preprocessor):
    """Public names in backquotes become links to their pages."""

    def __init__(self, md: Markdown, names: dict[str, str]):
        super().__init__(md)
        self.names = names

    def run(self, lines: list[str]) -> list[str]:
        """Link what is no heading."""
        return [
            line if line.startswith("#") else NAME.sub(self._link, line)
            for line in lines
        ]

    def _link(self, match: re.Match[str]) -> str:
        target = self.names.get(match["name"])
        return f"[{match[0]}][{target}]" if target else match[0]


class SiteExtension(Extension):
    """All of the above; the option `names` leads from what is written to a path."""

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
    """Make the extension, as Python-Markdown asks for it."""
    return SiteExtension(**kwargs)
