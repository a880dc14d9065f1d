"""What a request may ask for. Strict: no unknown field, no NaN, no number for a bool or bool for a number."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from refract_core.models import MODELS

if TYPE_CHECKING:
    Model = str
else:
    Model = Literal[MODELS]
Tier = Literal["screen", "ray", "probe", "sky"]
Purpose = Literal["default", "render", "proxy", "guide"]
Aov = Literal[
    "beauty", "refraction", "reflection", "transmittance", "albedo", "N", "P", "denoising_normal", "Z", "mask",
    "thickness", "path_length", "layers", "weight.screen", "weight.ray", "weight.probe", "weight.sky",
    "weight.none", "confidence",
]  # fmt: skip
Path = Annotated[str, StringConstraints(min_length=1, max_length=1024, pattern=r"^[^\x00-\x1f\x7f]+$")]
PrimPath = Annotated[str, StringConstraints(min_length=1, max_length=1024, pattern=r"^/[^\x00-\x1f\x7f]*$")]
Point = Annotated[list[Annotated[float, Field(ge=-1e12, le=1e12)]], Field(min_length=3, max_length=3)]
_Once = Field(json_schema_extra={"uniqueItems": True})
Side = Annotated[int, Field(ge=1, le=1 << 28)]
TimeCode = Annotated[float, Field(ge=-1e9, le=1e9)]
Variant = Annotated[
    str,
    StringConstraints(max_length=1024, pattern=r"^[^\x00-\x1f\x7f{}=]*\{[^\x00-\x1f\x7f{}=]+=[^\x00-\x1f\x7f{}=]+\}$"),
    Field(description="`/Prim{set=name}`; without a path it is of the default prim"),
]
Unit = Annotated[float, Field(ge=0.0, le=1.0)]
Length = Annotated[float, Field(gt=0.0, le=1e9, description="in the stage's own units")]
Address = Annotated[str, StringConstraints(min_length=8, max_length=2048, pattern="^https?://[!-~]+$")]


class Strict(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


class Override(Strict):
    """Values of one material that win over what the stage authors."""

    model: Model | None = None
    ior: Annotated[float, Field(ge=1.0, le=10.0)] | None = None
    thickness: Length | None = None
    roughness: Unit | None = None
    transmittanceColor: Annotated[list[Unit], Field(min_length=3, max_length=3)] | None = None
    absorptionDistance: Length | None = None
    abbeNumber: Annotated[float, Field(ge=0.0, le=1000.0)] | None = None


class StageOnly(Strict):
    """`POST /v1/inspect`, `/v1/validate`."""

    stage: Path | None = Field(None, description=(
        "a stage of GET /v1/stages; of an upload of several files, the one to open; leave it out when one file is "
        "uploaded"
    ))  # fmt: skip
    webhook: Address | None = Field(
        None, description="address that is told when the job has ended, by a signed POST of the job"
    )


class Render(StageOnly):
    """`POST /v1/render`. What is left out is as the stage's own render settings say, else as on the command line."""

    camera: Annotated[str, StringConstraints(max_length=1024, pattern=r"^[^\x00-\x1f\x7f]*$")] | None = None
    azimuth: Annotated[float, Field(ge=-1e6, le=1e6, description=(
        "side from which a camera of its own looks [degrees]: 0 is the front, 90 the right"
    ))] | None = None  # fmt: skip
    elevation: Annotated[float, Field(ge=-90.0, le=90.0, description="how high it stands [degrees]")] | None = None
    distance: Annotated[float, Field(ge=1e-9, le=1e12, description=(
        "from what it looks at, in the stage's own units"
    ))] | None = None  # fmt: skip
    fit: Annotated[float, Field(ge=0.01, le=1000.0, description=(
        "in place of distance: how much larger the frame is than what it frames"
    ))] | None = None  # fmt: skip
    fov: Annotated[float, Field(ge=0.1, le=175.0, description="angle of the picture's width [degrees]")] | None = None
    focal_length: Annotated[float, Field(ge=0.1, le=1e4, description=(
        "in place of fov: of a lens before a film 20.955 mm wide [mm]"
    ))] | None = None  # fmt: skip
    look_at: PrimPath | Point | None = Field(
        None, description="in the middle of the picture: a point in the stage's own units, or the path of a prim"
    )
    image_width: Annotated[int, Field(ge=1, le=1 << 28)] | None = None
    image_height: Annotated[int, Field(ge=0, le=1 << 28, description="0 follows the camera's aspect")] | None = None
    quality: Literal["draft", "good", "best", "reference"] | None = None
    preset: Literal["hdrp", "arm"] | None = None
    samples: Annotated[int, Field(ge=1, le=4096)] | None = None
    tolerance: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    light_samples: Annotated[int, Field(ge=1, le=4096)] | None = None
    caustics: Annotated[int, Field(ge=0, le=1 << 24, description="photons through glass; 0 is none")] | None = None
    indirect: Literal["off", "one", "full"] | None = None
    cut: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    tiers: Annotated[list[Tier], Field(min_length=1, max_length=4), _Once] | None = None
    screen: Literal["march", "proxy", "traced"] | None = None
    model: Model | None = None
    max_layers: Annotated[int, Field(ge=1, le=32, description="surfaces of glass that a ray may enter")] | None = None
    denoise: bool | None = Field(
        None, description="take the noise out of the picture with Open Image Denoise; other planes stay"
    )
    exposure: Annotated[float, Field(ge=-64.0, le=64.0)] | None = None
    motion_blur: bool | None = None
    camera_light: bool | None = None
    emission_light: bool | None = None
    studio: Literal["softbox", "daylight", "dark", "none"] | None = None
    background: (
        Annotated[str, StringConstraints(max_length=11, pattern=r"^(transparent|environment|#[0-9a-fA-F]{6})$")] | None
    ) = Field(None, description="what is seen past everything, and through glass")
    purposes: Annotated[list[Purpose], Field(min_length=1, max_length=4), _Once] | None = None
    time_code: TimeCode | None = None
    widths: Annotated[list[Side], Field(min_length=1, max_length=64), _Once] | None = Field(
        None, description="a picture of each width [pixels], in place of image_width and image_height"
    )
    time_codes: Annotated[list[TimeCode], Field(min_length=1, max_length=4096), _Once] | None = Field(
        None, description="a picture of each time code, in place of time_code"
    )
    variants: Annotated[list[Variant], Field(max_length=64), _Once] | None = None
    format: Literal["png", "jpeg", "webp", "avif", "exr"] | None = Field(
        None, description="of the picture; left out, the header Accept chooses"
    )
    aovs: Annotated[list[Aov], Field(max_length=19), _Once] | None = None
    color_correction: Literal["disabled", "sRGB", "openColorIO"] | None = None
    overrides: Annotated[dict[Path, Override], Field(max_length=256)] | None = None


class LiveStage(StageOnly):
    """`POST /v1/live`."""

    variants: Annotated[list[Variant], Field(max_length=64), _Once] | None = None


class Viewer(BaseModel):
    """What `POST /v1/live` answers."""

    id: str
    idle_seconds: int = Field(description="after which it ends where no picture is asked for [s]")
    links: dict[str, str]


class Convert(StageOnly):
    """`POST /v1/convert`. Answers with a .usdz, or, where JSON is accepted, with what was done."""

    model: Model | None = None
    only: Annotated[list[Path], Field(max_length=256)] | None = None
    thickness: Literal["typed", "measured"] | None = None
    to: Literal["preview", "openpbr", "gltf"] | None = None
    flatten: bool | None = None


class BakeProbes(StageOnly):
    """`POST /v1/bake-probes`. Answers with a .usdz, or, where JSON is accepted, with what was done."""

    only: Annotated[list[Path], Field(max_length=256)] | None = None
    resolution: Annotated[int, Field(ge=8, le=4096, description=(
        "texels on a side of each face; left out, each probe's own"
    ))] | None = None  # fmt: skip
    layout: Literal["strip", "cross", "latlong"] | None = None
    samples: Annotated[int, Field(ge=1, le=4096, description="rays per texel; left out, 16")] | None = None


class BakeThickness(StageOnly):
    """`POST /v1/bake-thickness`. Answers with a .usdz, or, where JSON is accepted, with what was done."""

    only: Annotated[list[Path], Field(max_length=256)] | None = None
    along: Literal["normal", "refracted"] | None = None
    texture: Annotated[int, Field(ge=16, le=8192, description=(
        "texels on a side of a picture in each object's own uv; left out, primvars"
    ))] | None = None  # fmt: skip


class Warning_(BaseModel):
    model_config = ConfigDict(title="Warning")
    path: str
    text: str


class AovPicture(BaseModel):
    name: str
    href: str
    white: float = Field(description="value of a white pixel; black is 0")


class Picture(BaseModel):
    href: str
    width: int
    height: int
    time_code: float


class View(BaseModel):
    """A camera, as fields of a render say it: where one that turns around what is seen starts from."""

    camera: str = Field(description="its path; empty where the stage has none, and everything is framed")
    azimuth: float = Field(description="[degrees]")
    elevation: float = Field(description="[degrees]")
    distance: float = Field(description="from what it looks at, in the stage's own units")
    look_at: list[float] = Field(description="what is in the middle, in the stage's own units")
    width: float = Field(description="of the picture, at distance 1; in metres where it is orthographic")
    orthographic: bool


class FieldProblem(BaseModel):
    pointer: str = Field(description="JSON pointer (RFC 6901) into the settings")
    detail: str


class ProblemDocument(BaseModel):
    """RFC 9457. Its type is the address of a page about it."""

    model_config = ConfigDict(title="Problem")
    type: Annotated[str, StringConstraints(pattern="^/problems/[a-z-]+$")]
    title: str
    status: Annotated[int, Field(ge=400, le=599)]
    detail: str
    instance: str = Field("", description="the job")
    errors: list[FieldProblem] = []
    prim: str = Field("", description="path of the prim that is wrong")


class Job(BaseModel):
    """What `GET /v1/jobs/{id}` answers."""

    id: str
    kind: Literal["render", "convert", "bake-probes", "bake-thickness", "inspect", "validate"]
    status: Literal["queued", "running", "done", "failed", "cancelled"]
    fraction: float
    stage_of_work: str
    created: str
    started: str | None
    finished: str | None
    warnings: list[Warning_]
    width: int | None
    height: int | None
    aovs: list[AovPicture]
    pictures: list[Picture] = Field(description="where there are several")
    view: View | None = Field(description="of one picture that is drawn: the stage's camera that it starts from")
    problem: ProblemDocument | None
    links: dict[str, str]


class StageFile(BaseModel):
    path: str = Field(description="what a request calls it")
    bytes: int
    picture: str = Field(description="address of the picture that lies beside it; empty where none does")


class Stages(BaseModel):
    stages: list[StageFile]


class Limit(BaseModel):
    name: str
    value: int
    default: int
    unit: str
    meaning: str
    variable: str = Field(description="of the environment, which sets it")
    flag: str = Field(description="of `refract serve`, which sets it")


class LimitTable(BaseModel):
    limits: list[Limit]
    workers: int = Field(description="jobs at once")
    queue: int = Field(description="jobs that may wait")
    confinement: dict[str, Any] = Field(description="what confines workers on this machine")


KINDS: dict[str, type[StageOnly]] = {
    "render": Render, "convert": Convert, "bake-probes": BakeProbes, "bake-thickness": BakeThickness,
    "inspect": StageOnly, "validate": StageOnly,
}  # fmt: skip
