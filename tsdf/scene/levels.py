"""Levels of detail, best first: what each of them is, for whoever asks, kernels included."""

from typing import NamedTuple


class Traits(NamedTuple):
    """What a level does, as kernels ask for it."""

    spheres: bool = False  # free paths run between bounding spheres, not between points
    tabulated: bool = False  # light is deflected as the table says, whatever it met before
    jumps: bool = False  # it then leaves a grain elsewhere than it came, as if it jumped
    joint: bool = False  # such offsets are drawn as joint records of the table
    remembers: bool = False  # light goes from sphere to sphere of a packing, by the table's records by entry
    packed: bool = False  # each grain has its place and is met there
    answered: bool = False  # it is not traced but answered by the table's records by entry
    lobe: bool = False  # light is deflected as by one Henyey-Greenstein lobe
    similar: bool = False  # light is deflected anywhere, after free paths that much longer

    @property
    def placed(self) -> bool:
        """Whether grains stand one by one, where there is room."""
        return self.remembers or self.packed

    @property
    def leaps(self) -> bool:
        """Whether many events can be taken in one step: grains are drawn anew wherever light comes."""
        return not self.packed

    @property
    def chains(self) -> bool:
        """Whether light goes from grain to grain by a law, so that it can begin at any grain; see `walk.hybrid`."""
        return self.jumps or self.remembers

    @property
    def points(self) -> bool:
        """Whether grains are points, that know no path length inside."""
        return self.lobe or self.similar


class Records(NamedTuple):
    """Records that a level draws from: the block of a table that has them, their name, what makes `tsdf-build` keep
    them."""

    block: str
    name: str
    option: str


class Level(NamedTuple):
    """A level: its traits, the records it needs, and how charts show it.

    Colours are to be told apart by all eyes (Okabe & Ito 2008).
    """

    traits: Traits
    colour: str
    mark: str = "o"
    records: Records | None = None


AUTO = "auto"  # no level, but whichever a plan takes
BY_ENTRY = Records("memory", "records by entry", "--memory 64")
LEVELS = {
    "explicit": Level(Traits(spheres=True, packed=True), "#000000", "s"),
    "teleport-packed": Level(Traits(spheres=True, packed=True, answered=True), "#999999", "P", BY_ENTRY),
    "teleport-memory": Level(Traits(spheres=True, remembers=True), "#0072b2", records=BY_ENTRY),
    "teleport-joint": Level(
        Traits(spheres=True, tabulated=True, jumps=True, joint=True),
        "#009e73",
        "^",
        Records("joint", "joint records", "--joint 32"),
    ),
    "teleport": Level(Traits(spheres=True, tabulated=True, jumps=True), "#d55e00", "v"),
    "volume": Level(Traits(tabulated=True), "#e69f00", "D"),
    "volume-hg": Level(Traits(lobe=True), "#cc79a7"),
    "isotropic": Level(Traits(similar=True), "#56b4e9"),
}
DETAILED = tuple(name for name, level in LEVELS.items() if not level.traits.points)  # the table's own light
