"""Films: machines and robots drawn with light and shadows, or shown in a browser."""

from ._looks import Looks as Looks
from ._render import render as render
from ._view import view as view
