"""The table of refraction models: one row each, read by everything that names, checks, draws or explains them.

How light goes through a model is a function of `optics.models` under the row's name; both together are the model. What
else has to change for a new one: the words a stage may use (`schemas/schema.usda`, from which the rest of the schema is
generated), and the pages of documentation. Tests hold both to this table.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple

LEAST_THICKNESS = 1e-4
"""What a thickness of 0 is drawn as [m] (HDRP, Lit.hlsl)."""


class Behind(Enum):
    """What a model takes to stand behind the surface, and so the shape that it suits."""

    NOTHING = "nothing"
    BALL = "a ball that touches the surface from inside, as wide as the thickness"
    SLAB = "a second face parallel to the surface, one thickness away"
    SHEET = "a wall so thin that it has no inside: light enters it on either side, and passes"
    MESH = "the mesh itself, followed to its far side"
    SCENE = "the scene: light turns at the surface, once, and there is no far side to leave by"


class Row(NamedTuple):
    """What is known of a model beside its token and number."""

    help: str
    """One line that explains the token, as the schema and the commands' help show it."""
    behind: Behind
    needs_closed: bool = False
    """On an open mesh it makes no sense. One that follows the mesh is drawn there as the model of a sheet."""
    fixed_thickness: float = 0.0
    """> 0: thickness and absorption distance are this whatever is authored [m]."""
    least_thickness: float = LEAST_THICKNESS
    """[m]"""


class Model(IntEnum):
    """How a material bends light. The value is what kernels see; numbers are never given anew, new rows come last."""

    NONE = 0, Row("no refraction", Behind.NOTHING)
    SPHERE = 1, Row("a ball whose diameter is the thickness, touching the surface", Behind.BALL, needs_closed=True)
    BOX = 2, Row("a slab with a second face parallel to the surface, one thickness away", Behind.SLAB)
    # HDRP, REFRACTION_THIN_DISTANCE
    THIN = 3, Row(
        "a pane or a shell: a slab of 5 mm, whatever thickness and absorption distance say",
        Behind.SHEET,
        fixed_thickness=0.005,
    )
    TRACED = 4, Row("the real mesh, to the real exit", Behind.MESH, needs_closed=True)
    # Arm, "Refraction based on local cubemaps"
    SINGLE = 5, Row("one interface: refracted at the surface, straight into the scene, without an exit", Behind.SCENE)

    row: Row

    def __new__(cls, number: int, row: Row) -> Model:
        member = int.__new__(cls, number)
        member._value_ = number
        member.row = row
        return member

    @property
    def token(self) -> str:
        """How stages, commands and requests call it."""
        return self.name.lower()

    @property
    def behind(self) -> Behind:
        return self.row.behind

    @property
    def fixed_thickness(self) -> float:
        """[m]; 0 where the thickness is authored, or none is needed."""
        return self.row.fixed_thickness

    @property
    def sized(self) -> bool:
        """It needs to be told a thickness."""
        return self.behind in (Behind.BALL, Behind.SLAB)


BY_TOKEN: dict[str, Model] = {model.token: model for model in Model}
MODELS = tuple(BY_TOKEN)
"""All tokens, in the order of their numbers."""
DEFAULT = Model.SPHERE
"""The schema's fallback."""


def model_for(body: Behind) -> Model:
    """The model that suits a body: the first one in the table."""
    return next(model for model in Model if model.behind is body)


SHEET, SOLID = model_for(Behind.SHEET), model_for(Behind.MESH)
"""What glass is drawn as that its shader alone describes: walls without an inside, and bodies of any shape."""


def explained() -> str:
    """Every token with what it means, for a person."""
    return ", ".join(f"{model.token} ({model.row.help})" for model in Model)
