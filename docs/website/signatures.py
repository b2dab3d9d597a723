"""The arguments of classes that take their fields as arguments, for the API pages.

The generator reads the sources without importing them. It knows dataclasses, but
not `equinox.Module`.
"""

from collections.abc import Iterator
from typing import Any

import griffe


class ModuleFields(griffe.Extension):
    """Give each subclass of `equinox.Module` an `__init__` that takes its fields."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Mark the subclasses as dataclasses, but only while `__init__` is created."""
        marked = [made for made in _classes(pkg) if _has_fields(made)]
        for made in marked:
            mark = griffe.ExprName("dataclasses.dataclass")
            made.decorators.append(griffe.Decorator(mark, lineno=None, endlineno=None))
            for member in made.members.values():
                if isinstance(member, griffe.Attribute):
                    _mark(member)
        griffe.DataclassesExtension().on_package(pkg=pkg)
        for made in marked:
            made.decorators.pop()
            made.labels.discard("dataclass")


def _has_fields(made: griffe.Class) -> bool:
    """Return whether a class is a module whose fields are its arguments."""
    line = [made, *made.mro()]
    bases = {str(base) for parent in line for base in parent.bases}
    return "eqx.Module" in bases and not any("__init__" in c.members for c in line)


def _classes(module: griffe.Module) -> Iterator[griffe.Class]:
    for member in module.members.values():
        if isinstance(member, griffe.Class):
            yield member
        elif isinstance(member, griffe.Module):
            yield from _classes(member)


def _mark(field: griffe.Attribute) -> None:
    """Make a field of Equinox look like a field of `dataclasses`."""
    value = field.value
    if isinstance(value, griffe.ExprCall) and str(value.function) == "eqx.field":
        value.function = griffe.ExprName("dataclasses.field")
    if str(field.annotation).startswith("eqx.Abstract"):
        field.labels.discard("instance-attribute")
        field.labels.add("class-attribute")
