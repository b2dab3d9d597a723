"""Models of robots in MJCF, which cover the joints and forces that nhjax supports."""

# No geom collides, so that MuJoCo computes no contacts.
_HEAD = """<mujoco><compiler angle="radian"/><option gravity="0.3 -0.2 -9.81"/>
<default><geom contype="0" conaffinity="0" mass="0.7"/></default>"""


def _model(bodies: str, rest: str = "") -> str:
    return f"{_HEAD}<worldbody>{bodies}</worldbody>{rest}</mujoco>"


def _chain(axes: tuple[str, ...]) -> str:
    text = ""
    for number, axis in reversed(list(enumerate(axes))):
        text = (
            f'<body name="link{number}" pos="0.1 0.05 -0.4" euler="0.1 0.2 0.3">'
            f'<joint name="q{number}" axis="{axis}" pos="0.01 0.02 0"/>'
            f'<geom type="box" size="0.05 0.04 0.2" pos="0 0.01 -0.2"/>{text}</body>'
        )
    return text


def _leg(number: int, x: float, y: float) -> str:
    return f"""<body name="hip{number}" pos="{x} {y} 0">
      <joint name="abduct{number}" axis="1 0 0" armature="0.01" damping="0.1"/>
      <geom type="box" size="0.05 0.03 0.03"/>
      <body name="thigh{number}" pos="0 {y / 2} 0">
        <joint name="swing{number}" axis="0 1 0" armature="0.01" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.02 0 -0.2" size="0.03"/>
        <body name="shank{number}" pos="0.02 0 -0.2">
          <joint name="knee{number}" axis="0 1 0" armature="0.01" damping="0.1"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02"/>
        </body>
      </body>
    </body>"""


_QUADRUPED = f"""<body name="trunk" pos="0 0 0.5"><freejoint name="trunk"/>
  <geom type="box" size="0.3 0.15 0.06" mass="6" pos="0.02 0 0.01"/>
  {_leg(0, 0.25, 0.1)}{_leg(1, 0.25, -0.1)}{_leg(2, -0.25, 0.1)}{_leg(3, -0.25, -0.1)}
  </body>"""
_MOTORS = "".join(
    f'<motor joint="{name}{i}" gear="{2 + i}"/>'
    for i in range(4)
    for name in ("abduct", "swing", "knee")
)

OPEN = {
    "pendulum chain": _model(_chain(("0 1 0", "1 0 0", "0 1 1", "0 0 1"))),
    "cart and pole": _model(
        """<body name="cart"><joint name="cart" type="slide" axis="1 0 0.1"/>
        <geom type="box" size="0.2 0.1 0.1"/>
        <body name="pole" pos="0 0 0.1"><joint name="pole" axis="0 1 0" ref="0.2"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.03"/></body></body>""",
        """<actuator><motor name="push" joint="cart" gear="3" ctrllimited="true"
        ctrlrange="-5 5"/></actuator>""",
    ),
    "free body": _model(
        """<body name="stone" pos="1 2 3"><freejoint name="stone"/>
        <geom type="box" size="0.1 0.2 0.3" pos="0.05 0.02 -0.1" euler="0.3 0 0.2"/>
        </body>"""
    ),
    "ball joint": _model(
        """<body name="top" pos="0.3 0 1" euler="0.2 0.1 0">
        <joint name="top" type="ball" pos="0 0.1 0.2" armature="0.03" damping="0.2"
          stiffness="1.5"/>
        <geom type="ellipsoid" size="0.1 0.2 0.3" pos="0.05 0 0.3"/>
        <body name="arm" pos="0 0 0.5"><joint name="arm" axis="1 1 0"/>
        <geom type="box" size="0.2 0.05 0.05" pos="0.2 0 0"/></body></body>""",
        """<actuator><motor name="twist" joint="top" gear="0.5 -1 2"/></actuator>""",
    ),
    "arm with springs and servos": _model(
        """<body name="upper" pos="0 0 1">
        <joint name="yaw" axis="0 0 1" armature="0.1" damping="0.4 0.1 0.05"/>
        <joint name="pitch" axis="0 1 0" damping="0.3" stiffness="5 0.4 0.7"
          springref="0.3"/>
        <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05"/>
        <body name="tool" pos="0.4 0 0" gravcomp="0.6"><geom type="sphere" size="0.05"/>
          <body name="fore" pos="0 0 0.02">
          <joint name="elbow" axis="0 1 0" stiffness="2" ref="0.1"/>
          <joint name="reach" type="slide" axis="1 0 0.2" stiffness="9"
            springref="0.1"/>
          <geom type="box" size="0.2 0.03 0.04" pos="0.2 0 0"/></body>
        </body></body>""",
        """<tendon><fixed name="belt" stiffness="3" damping="0.2" armature="0.05"
            springlength="0.1">
          <joint joint="pitch" coef="0.6"/><joint joint="elbow" coef="-0.4"/></fixed>
        </tendon>
        <actuator><position joint="yaw" kp="7" kv="0.5" gear="2"/>
        <velocity joint="pitch" kv="2"/><motor tendon="belt" gear="1.5"/>
        <general joint="reach" gaintype="affine" gainprm="2 0.3 0.1" biastype="affine"
          biasprm="0.4 -1 -0.2"/>
        <motor joint="elbow" gear="3" armature="0.02" damping="0.3"/></actuator>""",
    ),
    "differential drive": _model(
        """<body name="base" pos="0 0 0.15"><freejoint name="base"/>
        <geom type="box" size="0.3 0.2 0.05" pos="0.05 0 0.05" mass="5"/>
        <body name="right" pos="0 -0.3 0"><joint name="right" axis="0 1 0"/>
        <geom type="cylinder" size="0.15 0.02" euler="1.5707963267948966 0 0"/></body>
        <body name="left" pos="0 0.3 0"><joint name="left" axis="0 1 0"/>
        <geom type="cylinder" size="0.15 0.02" euler="1.5707963267948966 0 0"/></body>
        </body>""",
        """<actuator><motor joint="right"/><motor joint="left"/>
        <motor name="thrust" joint="base" gear="1 0.5 2 0.1 0.2 -0.3"/></actuator>""",
    ),
    "quadruped": _model(_QUADRUPED, f"<actuator>{_MOTORS}</actuator>"),
    "two trees": _model(
        """<body name="first" pos="0 0 1"><joint name="first" axis="0 1 0"/>
        <geom type="box" size="0.05 0.05 0.2" pos="0 0 -0.2"/></body>
        <body name="second" pos="1 0 1"><freejoint name="second"/>
        <geom type="box" size="0.1 0.2 0.1"/></body>
        <body name="third" pos="2 0 1"><joint name="third" type="slide" axis="0 0 1"/>
        <geom type="box" size="0.1 0.2 0.1"/></body>"""
    ),
}

CLOSED = {
    "four-bar": _model(
        """<body name="crank"><joint name="crank" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.02"/>
        <body name="coupler" pos="0 0 0.3"><joint name="coupler" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.5 0 0.1" size="0.02"/></body></body>
        <body name="rocker" pos="0.5 0 0"><joint name="rocker" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.4" size="0.02"/></body>""",
        """<equality><connect name="loop" body1="coupler" body2="rocker"
        anchor="0.5 0 0.1"/></equality>""",
    ),
    "weld": _model(
        """<body name="lower" pos="0 0 1"><joint name="lower" type="ball"/>
        <geom type="box" size="0.05 0.05 0.2" pos="0 0 0.2"/></body>
        <body name="upper" pos="0.3 0 1.4" euler="0.2 0.4 0.1">
        <freejoint name="upper"/><geom type="box" size="0.1 0.2 0.1" pos="0.1 0 0"/>
        </body>""",
        """<equality><weld name="glue" body1="lower" body2="upper"/></equality>""",
    ),
    "joint equality": _model(
        _chain(("0 1 0", "1 0 0", "0 1 0")),
        """<equality><joint name="gears" joint1="q0" joint2="q2"
        polycoef="0.1 0.5 0.2 -0.1 0.05"/></equality>""",
    ),
}
