"""The documentation as a site: `python -m docs.website build` makes it, offline.

- `pages` gathers the pages of `docs/`, benchmarks and notebooks, and keeps their links.
- `api` makes a page for each public name, in the order of `groups`.
- `extension` and `signatures` tell the generator how docstrings and maths are written.
- `links` reads the built pages and finds what leads nowhere or outside.
"""
