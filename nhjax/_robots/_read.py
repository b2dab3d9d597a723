"""Reading a model with MuJoCo's compiler, and the parts that nhjax does not support.

MuJoCo is an optional dependency, and is imported when it is first needed.
"""

import importlib
import math
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._errors import check_choice


# Angles in URDF files that differ by less than this [rad] from a nonzero multiple of a
# quarter turn are replaced by this multiple.
_ROUNDED_ANGLE = 1e-3
# URDF files that were written for ROS name the files of meshes by addresses that begin
# with this prefix.
_PACKAGE = "package://"

IGNORABLE = (
    "actuators",
    "contacts",
    "equalities",
    "fluid",
    "friction loss",
    "limits",
    "plugins",
    "springs",
    "tendons",
)


def mujoco_of(who: str, extra: str) -> Any:
    """Import MuJoCo, or raise an `ImportError` that says how to install it."""
    try:
        return importlib.import_module("mujoco")
    except ImportError as error:
        raise ImportError(
            f'{who} needs MuJoCo: pip install "nhjax[{extra}]".'
        ) from error


def mujoco() -> Any:
    """Import MuJoCo for `from_mujoco`."""
    return mujoco_of("from_mujoco", "robots")


def compile_model(
    model: Any, root: str | None, motors: Sequence[str]
) -> tuple[Any, Any]:
    """Return a model as an `MjSpec`, and the compiled model.

    Films can add a scene to the `MjSpec`. For an `MjModel`, both results are this
    `MjModel`. Each joint in `motors` gets a motor.
    """
    library = mujoco()
    if isinstance(motors, str):
        raise TypeError(
            "from_mujoco: `motors` must be a sequence of names of joints, got "
            f"{motors!r}; write `motors=({motors!r},)`."
        )
    if root is not None:
        check_choice("from_mujoco: `root`", root, ("free", "planar", "fixed"))
    if isinstance(model, library.MjModel | library.MjSpec):
        if root is not None:
            raise ValueError(
                "from_mujoco: `root` is for URDF files only. Give the first body of "
                f"this {type(model).__name__} the joints that it needs."
            )
        if isinstance(model, library.MjModel):
            if motors:
                raise ValueError(
                    "from_mujoco: an MjModel cannot get `motors`: pass an MjSpec."
                )
            return model, model
        # Use a copy, because the caller may change the spec later.
        spec = model.copy()
        return spec, _compile(spec, motors, "the MjSpec")
    if not isinstance(model, str | os.PathLike):
        raise TypeError(
            "from_mujoco: `model` must be the path of an MJCF or URDF file, a "
            f"mujoco.MjSpec or a mujoco.MjModel, got {type(model).__name__}."
        )
    return _compile_file(Path(model), root, motors)


def _add_motors(spec: Any, motors: Sequence[str]) -> None:
    """Add a motor with the gear 1 to each joint in `motors`."""
    library = mujoco()
    joints = {joint.name: joint for joint in spec.joints}
    scalar = library.mjtJoint.mjJNT_HINGE, library.mjtJoint.mjJNT_SLIDE
    names = [name for name, joint in joints.items() if name and joint.type in scalar]
    for name in motors:
        if name not in names:
            raise ValueError(
                f"from_mujoco: `motors` has {name!r}, but the joints that can have a "
                f"motor are {', '.join(names)}."
            )
        motor = spec.add_actuator(
            name=name, target=name, trntype=library.mjtTrn.mjTRN_JOINT
        )
        motor.set_to_motor()


def _compile_file(
    path: Path, root: str | None, motors: Sequence[str]
) -> tuple[Any, Any]:
    if not path.is_file():
        is_text = str(path).lstrip().startswith("<")
        advice = (
            " To read a string, pass `mujoco.MjSpec.from_string(text)`."
            if is_text
            else ""
        )
        shown = f"{str(path)[:60]}..." if is_text else str(path)
        raise FileNotFoundError(f"from_mujoco: there is no file {shown}.{advice}")
    try:
        tree = ElementTree.parse(path)
    except ElementTree.ParseError as error:
        raise ValueError(f"from_mujoco: {path} is not an XML file: {error}.") from error
    spec_of = mujoco().MjSpec
    if tree.getroot().tag == "robot":
        _set_root(tree.getroot(), path, root)
        _complete_quarter_turns(tree.getroot())
        _find_packages(tree.getroot(), path)
        text = ElementTree.tostring(tree.getroot(), encoding="unicode")
        spec = _or_message(lambda: spec_of.from_string(text), path)
        # MuJoCo then searches for meshes in the folder of the URDF file.
        spec.modelfiledir = str(path.parent)
        return spec, _compile(spec, motors, path)
    if root is not None:
        raise ValueError(
            f"from_mujoco: `root` is for URDF files only, and {path.name} is an MJCF "
            'file. Give its first body the joints that it needs, such as a "freejoint".'
        )
    spec = _or_message(lambda: spec_of.from_file(str(path)), path)
    return spec, _compile(spec, motors, path)


def _set_root(robot: ElementTree.Element, path: Path, root: str | None) -> None:
    """Add the joint, if any, that `root` puts between the world and the root link."""
    links = [link.get("name") for link in robot.findall("link")]
    children = [child.get("link") for child in robot.findall("joint/child")]
    roots = [name for name in links if name not in children]
    if len(roots) != 1:
        raise ValueError(
            f"from_mujoco: {path.name} has {len(roots)} root links "
            f"({', '.join(map(str, roots))}), but a robot has one."
        )
    if roots == ["world"]:
        if root is not None:
            raise ValueError(
                f"from_mujoco: {path.name} has a link named world, whose joints say "
                "how the robot can move: omit `root`."
            )
        return
    if root in (None, "fixed"):
        return
    kind = {"free": "floating", "planar": "planar"}[root]
    ElementTree.SubElement(robot, "link", name="world")
    joint = ElementTree.SubElement(robot, "joint", name="root", type=kind)
    ElementTree.SubElement(joint, "parent", link="world")
    ElementTree.SubElement(joint, "child", link=str(roots[0]))
    ElementTree.SubElement(joint, "axis", xyz="0 0 1")


def _complete_quarter_turns(robot: ElementTree.Element) -> None:
    """Replace rounded angles such as 1.5708 by quarter turns.

    Axles that are tilted by the rounding would give nearly dependent constraints.
    """
    quarter = math.pi / 2
    for element in robot.iter():
        words = element.get("rpy", "").split()
        for place, word in enumerate(words):
            try:
                turns = float(word) / quarter
            except ValueError:
                continue  # MuJoCo reports the mistake later.
            number = round(turns)
            if number and abs(turns - number) * quarter < _ROUNDED_ANGLE:
                words[place] = repr(number * quarter)
        if words:
            element.set("rpy", " ".join(words))


def _find_packages(robot: ElementTree.Element, path: Path) -> None:
    """Replace addresses of meshes in ROS packages by paths.

    The package of an address package://NAME/... is a folder NAME that contains the
    URDF file at any depth.
    """
    for mesh in robot.iter("mesh"):
        address = mesh.get("filename", "")
        package, _, rest = address.removeprefix(_PACKAGE).partition("/")
        if address.startswith(_PACKAGE):
            for folder in path.resolve().parents:
                if folder.name == package and (folder / rest).is_file():
                    mesh.set("filename", str(folder / rest))
                    break


def is_fixed_urdf(model: Any) -> bool:
    """Return whether a file is a URDF whose root link MuJoCo fixes to the world."""
    if not isinstance(model, str | os.PathLike):
        return False
    robot = ElementTree.parse(Path(model)).getroot()
    return robot.tag == "robot" and all(
        link.get("name") != "world" for link in robot.findall("link")
    )


def _compile(spec: Any, motors: Sequence[str], name: Any) -> Any:
    _add_motors(spec, motors)
    return _or_message(spec.compile, name)


def _or_message(function: Any, name: Any) -> Any:
    try:
        return function()
    except ValueError as error:
        advice = ""
        if "mjMINVAL" in str(error):
            advice = (
                " Give this body a geom with a mass, or masses and moments of inertia "
                "(`inertial`), or fix it to its parent."
            )
        if "Error opening file" in str(error):
            advice = (
                ". A mesh is searched for beside the file, and the mesh "
                "package://NAME/... in a folder NAME around it. If the file gives "
                "masses and inertias, delete the mesh from it: nhjax does not simulate "
                "contacts between shapes."
            )
        raise ValueError(
            f"from_mujoco: MuJoCo cannot read {name}: {error}{advice}"
        ) from error


def name_of(model: Any, kind: str, number: int) -> str:
    """Return the name of a part, or its kind and its number if it has none."""
    objects = mujoco().mjtObj
    code = getattr(objects, f"mjOBJ_{kind.upper()}")
    return mujoco().mj_id2name(model, code, number) or f"{kind}{number}"


def label_of(model: Any, geom: int) -> str:
    """Return the name (or the number) of a geom, with its shape and its body."""
    number = int(model.geom_bodyid[geom])
    body = name_of(model, "body", number) if number else "the world"
    word = mujoco().mjtGeom(model.geom_type[geom]).name[7:].lower()
    name = name_of(model, "geom", geom)
    owner = f"the body {body!r}" if number else body
    return f"{name!r} (a {word} of {owner})"


def has_flag(model: Any, name: str) -> bool:
    """Return whether the options of a model disable a feature."""
    return bool(
        model.opt.disableflags & int(getattr(mujoco().mjtDisableBit, f"mjDSBL_{name}"))
    )


# --- Parts that are not supported -----------------------------------------------------


class Unsupported(NamedTuple):
    """A part of a model that nhjax does not support.

    `category` is the word in `ignore` that leaves the part out, or None if there is no
    such word.
    """

    category: str | None
    what: str


def check_supported(
    model: Any, ignore: Sequence[str], rolling: Collection[int]
) -> dict[str, set[int]]:
    """Raise a `ValueError` for parts that are neither supported nor ignored.

    `rolling` has the indices of the geoms that roll. Return the indices of the
    actuators and of the equalities to leave out.
    """
    if isinstance(ignore, str):
        raise TypeError(
            f"from_mujoco: `ignore` must be a sequence of words, got {ignore!r}; write "
            f"`ignore=({ignore!r},)`."
        )
    for word in ignore:
        check_choice("from_mujoco: each word of `ignore`", word, IGNORABLE)
    left_out: dict[str, set[int]] = {"actuators": set(), "equalities": set()}
    found: list[Unsupported] = [*_bodies(model), *_joints(model)]
    found += [*_tendons(model), *_contacts(model, rolling)]
    for name, parts in (
        ("actuators", unsupported_actuators(model, "tendons" in ignore)),
        ("equalities", _equalities(model, "tendons" in ignore)),
    ):
        for number, what in parts:
            left_out[name].add(number)
            found.append(Unsupported(name, what))
    refused = [x for x in found if x.category is None or x.category not in ignore]
    if refused:
        raise ValueError(_refusal(refused))
    return left_out


def _refusal(refused: list[Unsupported]) -> str:
    lines = [f"- {x.what}" for x in refused[:8]]
    if len(refused) > 8:
        lines.append(f"- and {len(refused) - 8} more")
    words = sorted({x.category for x in refused if x.category is not None})
    listed = ", ".join(map(repr, words)) + ("," if len(words) == 1 else "")
    advice = ""
    if words:
        advice = f" To simulate the model without them, pass `ignore=({listed})`."
    if any(x.category is None for x in refused):
        advice += " Some of them cannot be ignored: change the model."
    return (
        "from_mujoco: the model has parts that nhjax does not support:\n"
        + "\n".join(lines)
        + f"\n{advice.strip()}"
    )


def _bodies(model: Any) -> Iterator[Unsupported]:
    if model.nv == 0:
        yield Unsupported(None, "no joint: nothing in the model can move")
    if model.nflex:
        yield Unsupported(None, f"flexes ({model.nflex}): deformable bodies")
    for body in np.flatnonzero(model.body_mocapid >= 0).tolist():
        name = name_of(model, "body", body)
        yield Unsupported(None, f"body {name!r}: its pose is given by mocap data")
    if model.opt.density or model.opt.viscosity:
        yield Unsupported(
            "fluid",
            f"forces of a fluid (density {model.opt.density:g} kg/m³, viscosity "
            f"{model.opt.viscosity:g} Pa s)",
        )
    for body in np.flatnonzero(model.body_plugin >= 0).tolist():
        name = name_of(model, "body", body)
        yield Unsupported("plugins", f"body {name!r}: a plugin acts on it")


def _joints(model: Any) -> Iterator[Unsupported]:
    has_limits = not (has_flag(model, "LIMIT") or has_flag(model, "CONSTRAINT"))
    for joint in range(model.njnt):
        name = name_of(model, "joint", joint)
        is_scalar = model.jnt_type[joint] >= 2
        dof = model.jnt_dofadr[joint]
        if has_limits and model.jnt_limited[joint]:
            yield Unsupported("limits", f"joint {name!r}: a limit of its range")
        if model.jnt_springyield[joint] > 0:
            yield Unsupported("springs", f"joint {name!r}: a spring that yields")
        if not is_scalar:
            if np.any(model.jnt_stiffness[joint]) and model.jnt_type[joint] == 0:
                yield Unsupported(
                    "springs", f"joint {name!r}: a spring of a free joint"
                )
            if np.any(model.jnt_stiffnesspoly[joint]):
                yield Unsupported(
                    "springs", f"joint {name!r}: a nonlinear spring of a ball joint"
                )
            if model.dof_frictionloss[dof]:
                yield Unsupported(
                    "friction loss", f"joint {name!r}: friction of a ball or free joint"
                )
        if not is_scalar and np.any(model.dof_dampingpoly[dof]):
            yield Unsupported(
                None, f"joint {name!r}: nonlinear damping of a ball or free joint"
            )
        if model.jnt_actgravcomp[joint] and model.jnt_actfrclimited[joint]:
            yield Unsupported(
                None,
                f"joint {name!r}: gravity compensation by an actuator with a limit",
            )
        # In a model without actuators, MuJoCo omits gravity compensation for joints
        # with `actgravcomp`, but not for other joints.
        if model.jnt_actgravcomp[joint] and model.ngravcomp and not model.nu:
            yield Unsupported(
                None,
                f"joint {name!r}: gravity compensation by actuators, without actuators",
            )


def _tendons(model: Any) -> Iterator[Unsupported]:
    for tendon in range(model.ntendon):
        name = name_of(model, "tendon", tendon)
        if not is_fixed_tendon(model, tendon):
            yield Unsupported(
                "tendons", f"tendon {name!r}: a spatial tendon, with a path over sites"
            )
            continue
        has_limits = not (has_flag(model, "LIMIT") or has_flag(model, "CONSTRAINT"))
        if has_limits and model.tendon_limited[tendon]:
            yield Unsupported("limits", f"tendon {name!r}: a limit of its length")
        lengths = model.tendon_lengthspring[tendon]
        has_spring = model.tendon_stiffness[tendon] or np.any(
            model.tendon_stiffnesspoly[tendon]
        )
        is_plain = lengths[0] == lengths[1] and not model.tendon_springyield[tendon]
        if has_spring and not (
            is_plain and not np.any(model.tendon_stiffnesspoly[tendon])
        ):
            yield Unsupported(
                "springs", f"tendon {name!r}: a spring that is not linear"
            )
        if model.tendon_frictionloss[tendon]:
            yield Unsupported("friction loss", f"tendon {name!r}: friction")
        if np.any(model.tendon_dampingpoly[tendon]):
            yield Unsupported(None, f"tendon {name!r}: nonlinear damping")
        if model.tendon_actfrclimited[tendon]:
            yield Unsupported(
                "limits", f"tendon {name!r}: a limit of the force of its actuators"
            )


def is_fixed_tendon(model: Any, tendon: int) -> bool:
    """Return whether a tendon is a linear combination of joint coordinates."""
    first = model.tendon_adr[tendon]
    wraps = model.wrap_type[first : first + model.tendon_num[tendon]]
    return bool(np.all(wraps == int(mujoco().mjtWrap.mjWRAP_JOINT)))


def unsupported_actuators(
    model: Any, without_tendons: bool
) -> Iterator[tuple[int, str]]:
    """Yield the index of each actuator that is not supported, and the reason."""
    library = mujoco()
    transmissions, gains = library.mjtTrn, library.mjtGain
    biases, dynamics = library.mjtBias, library.mjtDyn
    for i in range(model.nactuator):
        reason = None
        target = model.actuator_trnid[i, 0]
        kind = model.actuator_trntype[i]
        on_joint = kind in (
            int(transmissions.mjTRN_JOINT),
            int(transmissions.mjTRN_JOINTINPARENT),
        )
        is_vector = on_joint and model.jnt_type[target] < 2
        is_motor = model.actuator_gaintype[i] == int(
            gains.mjGAIN_FIXED
        ) and model.actuator_biastype[i] == int(biases.mjBIAS_NONE)
        muscle = int(dynamics.mjDYN_MUSCLE), int(gains.mjGAIN_MUSCLE)
        if model.actuator_plugin[i] >= 0:
            reason = "a plugin"
        elif (
            model.actuator_dyntype[i] == muscle[0]
            or model.actuator_gaintype[i] == muscle[1]
        ):
            reason = "a muscle"
        elif model.actuator_dyntype[i] != int(dynamics.mjDYN_NONE):
            word = library.mjtDyn(model.actuator_dyntype[i]).name[6:].lower()
            reason = f"internal dynamics ({word})"
        elif model.actuator_gaintype[i] > int(gains.mjGAIN_AFFINE):
            word = library.mjtGain(model.actuator_gaintype[i]).name[7:].lower()
            reason = f"the gain {word}"
        elif model.actuator_biastype[i] > int(biases.mjBIAS_AFFINE):
            word = library.mjtBias(model.actuator_biastype[i]).name[7:].lower()
            reason = f"the bias {word}"
        elif model.actuator_delay[i]:
            reason = "a delay"
        elif model.actuator_ctrlnum[i] != 1 or model.actuator_outnum[i] != 1:
            reason = "several controls or outputs"
        elif kind == int(transmissions.mjTRN_TENDON):
            if without_tendons or not is_fixed_tendon(model, target):
                reason = "a tendon that is left out or not supported"
        elif not on_joint:
            word = library.mjtTrn(kind).name[6:].lower()
            reason = f"the transmission {word}"
        elif is_vector and kind == int(transmissions.mjTRN_JOINTINPARENT):
            reason = "a transmission in the frame of the parent"
        elif is_vector and not is_motor:
            reason = "a servo on a ball or free joint"
        if reason is None and np.any(model.actuator_dampingpoly[i]):
            reason = "nonlinear damping"
        if (
            reason is None
            and is_vector
            and (model.actuator_damping[i] or model.actuator_armature[i])
        ):
            reason = "damping or armature on a ball or free joint"
        if reason is not None:
            name = name_of(model, "actuator", i)
            yield i, f"actuator {name!r}: {reason}"


def _equalities(model: Any, without_tendons: bool) -> Iterator[tuple[int, str]]:
    library = mujoco()
    supported = {
        int(library.mjtEq.mjEQ_CONNECT),
        int(library.mjtEq.mjEQ_WELD),
        int(library.mjtEq.mjEQ_JOINT),
    }
    tendon = int(library.mjtEq.mjEQ_TENDON)
    for i in active_equalities(model):
        kind = int(model.eq_type[i])
        name = name_of(model, "equality", i)
        if kind == tendon:
            ends = [x for x in (model.eq_obj1id[i], model.eq_obj2id[i]) if x >= 0]
            if without_tendons or not all(is_fixed_tendon(model, x) for x in ends):
                yield i, f"equality {name!r}: between tendons that are not supported"
        elif kind not in supported:
            word = library.mjtEq(kind).name[5:].lower()
            yield i, f"equality {name!r}: of the kind {word}"


def active_equalities(model: Any) -> list[int]:
    """Return the indices of the equalities that act from the start."""
    if has_flag(model, "EQUALITY") or has_flag(model, "CONSTRAINT"):
        return []
    return np.flatnonzero(model.eq_active0).tolist()


def _contacts(model: Any, rolling: Collection[int]) -> Iterator[Unsupported]:
    """Yield one entry for all pairs of geoms that can touch, unless they roll."""
    if has_flag(model, "CONTACT") or has_flag(model, "CONSTRAINT"):
        return
    pairs = [
        pair for pair in _touching_pairs(model) if not _rolls(model, pair, rolling)
    ]
    if pairs:
        first, second = (label_of(model, x) for x in pairs[0])
        more = f" and {len(pairs) - 1} more pairs of geoms" if len(pairs) > 1 else ""
        yield Unsupported("contacts", f"contacts: {first} and {second}{more} can touch")


def _rolls(model: Any, pair: tuple[int, int], rolling: Collection[int]) -> bool:
    """Return whether a pair is a rolling geom and a geom fixed to the world."""
    for one, other in (pair, pair[::-1]):
        if one in rolling and model.body_weldid[model.geom_bodyid[other]] == 0:
            return True
    return False


def _touching_pairs(model: Any) -> list[tuple[int, int]]:
    """List the pairs of geoms that can collide according to MuJoCo's filters."""
    pairs = {
        (min(a, b), max(a, b))
        for a, b in zip(
            model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True
        )
    }
    excluded = set(model.exclude_signature.tolist())
    types, affinities = model.geom_contype, model.geom_conaffinity
    body = model.geom_bodyid
    weld = model.body_weldid
    parent_of_weld = model.body_weldid[model.body_parentid[weld]]
    filters_parents = not has_flag(model, "FILTERPARENT")
    for a in range(model.ngeom):
        for b in range(a + 1, model.ngeom):
            one, other = int(body[a]), int(body[b])
            if weld[one] == weld[other]:
                continue
            if not (types[a] & affinities[b] or types[b] & affinities[a]):
                continue
            is_parent = (
                weld[one] == parent_of_weld[other] or weld[other] == parent_of_weld[one]
            )
            # This filter excludes pairs of parent and child, except if the parent is
            # the world.
            if filters_parents and is_parent and weld[one] and weld[other]:
                continue
            low, high = min(one, other), max(one, other)
            if (low << 16) + high in excluded:
                continue
            pairs.add((a, b))
    return sorted(pairs)
