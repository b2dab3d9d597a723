"""The documentation as a site: `python -m docs.website build` builds it offline.

- `pages` gathers the written pages, and `api` makes a page for each public name.
- `extension` and `signatures` extend the generator: maths, links of names, and the
  arguments of Equinox's modules.
"""
