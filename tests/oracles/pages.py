"""The blocks of code in pages of the documentation."""

import re


def blocks(text: str, language: str = "python") -> list[str]:
    """The blocks of one language, as printed."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
