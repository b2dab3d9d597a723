"""Which public names belong together: the order of the pages of the API."""

from typing import NamedTuple


class Group(NamedTuple):
    """Names that belong together.

    - `title`, `text`: what the page of the group begins with.
    - `space`: the module that has them, by its dotted name.
    """

    title: str
    text: str
    names: tuple[str, ...]
    space: str = "nhjax"

    @property
    def slug(self) -> str:
        """The name of its page."""
        return self.title.lower().replace(" ", "-")


GROUPS = (
    Group(
        "Systems and states",
        "What moves, and where it starts. [Writing a system](../../systems.md) and "
        "[constraints](../../constraints.md) are the guide to it.",
        (
            "LagrangianSystem",
            "HamiltonianSystem",
            "State",
            "initial_state",
            "continuous_multiplier",
        ),
    ),
    Group(
        "Methods",
        "The tableaux and the closures of the multiplier. "
        "[What to choose](../../choosing.md) compares them.",
        ("LobattoIIIAB", "Gauss", "PartitionedRungeKutta"),
    ),
    Group(
        "Running",
        "Many steps or one, what is saved of them, and how a run can end.",
        (
            "integrate",
            "step",
            "SaveAt",
            "Solution",
            "RESULTS",
            "DenseInterpolation",
            "Checkpoint",
            "save",
            "load",
            "engines",
            "EngineUse",
        ),
    ),
    Group(
        "Events",
        "Impacts, stops and constraints that let go: [the guide](../../events.md).",
        ("Event", "EventLog"),
    ),
    Group(
        "Stage solvers",
        "The iterations that solve the equations of a step: "
        "[when a step is solved](../../solvers.md).",
        (
            "SimplifiedNewton",
            "Newton",
            "AbstractStageSolver",
            "Solved",
            "stage_residual",
        ),
    ),
    Group(
        "Adjoints",
        "What reverse mode keeps of a trajectory: [derivatives](../../derivatives.md).",
        (
            "DirectAdjoint",
            "RecursiveCheckpointAdjoint",
            "ReversibleAdjoint",
            "AbstractAdjoint",
        ),
    ),
    Group(
        "Ensembles",
        "Many members, and statistics of them: [the guide](../../ensembles.md).",
        (
            "ensemble",
            "EnsembleOutcome",
            "Mean",
            "Variance",
            "Minimum",
            "Maximum",
            "Histogram",
            "HistogramCounts",
            "AbstractReduction",
        ),
    ),
    Group(
        "Groups and retractions",
        "Configuration spaces: vector spaces, Lie groups and products of them.",
        (
            "Euclidean",
            "SO2",
            "SO3",
            "SE2",
            "SE3",
            "ProductGroup",
            "Cayley",
            "Exponential",
            "AbstractLieGroup",
        ),
    ),
    Group(
        "Analysis",
        "What holds at one state: [the guide](../../analysis.md).",
        (
            "check_system",
            "SystemReport",
            "motion",
            "Motion",
            "steady_motion",
            "linear_stability",
            "LinearStability",
        ),
    ),
    Group(
        "SymPy",
        "Models that are written in SymPy: [the guide](../../sympy.md).",
        ("from_sympy", "SymPyModel"),
    ),
    Group(
        "Diagnostics",
        "Energy errors, momentum maps and orders of computed trajectories.",
        ("energy_error", "momentum_map", "convergence_order"),
    ),
    Group(
        "Plots",
        "Figures and animations of matplotlib. Every function draws into `ax`, or into "
        "a new figure, and returns the axes or the animation.",
        ("trajectory", "animate", "energy", "multiplier", "constraint", "convergence"),
        "nhjax.plot",
    ),
    Group(
        "Progress meters",
        "What tells how far a run has come.",
        (
            "TqdmProgressMeter",
            "TextProgressMeter",
            "NoProgressMeter",
            "AbstractProgressMeter",
        ),
    ),
    Group(
        "Errors",
        "What is raised, beside `TypeError` and `ValueError`. "
        "[Troubleshooting](../../troubleshooting.md) says what to do about each.",
        (
            "IntegrationError",
            "ConstraintViolationError",
            "DependentConstraintsError",
            "IncompatibleConstraintsError",
            "IrregularLagrangianError",
            "NewtonError",
            "NonFiniteError",
            "ShapeError",
            "DTypeError",
        ),
    ),
    Group(
        "Systems of the gallery",
        "Each with parameters, initial data, invariants and its source. "
        "[The gallery](../../gallery.md) has pictures of them.",
        (
            "NonholonomicParticle",
            "KnifeEdge",
            "ChaplyginSleigh",
            "VerticalRollingDisc",
            "RollingDisc",
            "Unicycle",
            "UnicycleInCoordinates",
            "ContinuouslyVariableTransmission",
            "ChaoticSystem",
            "Appell",
            "RodSleigh",
            "HarmonicOscillator",
            "SphericalPendulum",
            "DoublePendulum",
            "FreeRigidBody",
            "HeavyTop",
            "HeavyTopSE3",
            "Suslov",
            "Veselova",
            "TurntableBall",
            "WhippleBicycle",
            "SteerTorque",
            "LeanToSteer",
            "CarWithTrailers",
            "TwoWheeledRobot",
            "Snakeboard",
            "RollerRacer",
            "Rattleback",
            "RollingTorus",
            "ChaplyginSphere",
            "ChaplyginTop",
            "BallInBowl",
            "AndrewsSqueezer",
            "CarAxis",
            "SliderCrank",
            "FourBar",
            "SpatialSliderCrank",
            "FlyballGovernor",
            "PendulumChain",
        ),
        "nhjax.systems",
    ),
)
