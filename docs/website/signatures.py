"""The arguments of classes whose fields are their arguments, for the pages of the API.

The generator reads the sources without importing them. It knows `dataclasses`, and this
tells it of `equinox.Module`.
"""

from typing import Any

import griffe


class ModuleFields(griffe.Extension):
    """Give each subclass of `equinox.Module` the `__init__` that its fields make."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Find the arguments of all first: a base must not seem to have its own."""
        classes = [
            member
            for module in _modules(pkg)
            for member in module.members.values()
            if not member.is_alias and isinstance(member, griffe.Class)
        ]
        for made, parameters in [(made, _parameters(made)) for made in classes]:
            if parameters is not None:
                written = griffe.Function("__init__", parameters=parameters)
                made.set_member("__init__", written)


def _modules(module: griffe.Module) -> list[griffe.Module]:
    found = [module]
    for member in module.members.values():
        if not member.is_alias and isinstance(member, griffe.Module):
            found += _modules(member)
    return found


def _parameters(made: griffe.Class) -> griffe.Parameters | None:
    """The fields of a module, those of its bases first; None for other classes."""
    line = [made, *made.mro()]
    bases = {str(base) for parent in line for base in parent.bases}
    if "eqx.Module" not in bases or any("__init__" in c.members for c in line):
        return None
    fields: dict[str, griffe.Parameter] = {}
    for parent in reversed(line):
        for name, member in parent.members.items():
            if isinstance(member, griffe.Attribute) and _is_field(member):
                fields[name] = _parameter(name, member)
    keyword_only = griffe.ParameterKind.keyword_only
    ordered = sorted(fields.values(), key=lambda field: field.kind is keyword_only)
    self = griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)
    return griffe.Parameters(self, *ordered)


def _is_field(member: griffe.Attribute) -> bool:
    if member.annotation is None or "property" in member.labels:
        return False
    if "instance-attribute" not in member.labels:
        return False
    return not str(member.annotation).startswith("eqx.Abstract")


def _parameter(name: str, member: griffe.Attribute) -> griffe.Parameter:
    kind = griffe.ParameterKind.positional_or_keyword
    default: Any = member.value
    if isinstance(default, griffe.ExprCall) and str(default.function) == "eqx.field":
        options = {
            argument.name: argument.value
            for argument in default.arguments
            if isinstance(argument, griffe.ExprKeyword)
        }
        default = options.get("default")
        if str(options.get("kw_only")) == "True":
            kind = griffe.ParameterKind.keyword_only
    return griffe.Parameter(
        name, annotation=member.annotation, kind=kind, default=default
    )
