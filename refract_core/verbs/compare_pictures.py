"""`refract compare A B`: two picture files, in numbers and, if asked for, side by side."""

from __future__ import annotations

from dataclasses import dataclass

from ..images.pictures import read_planes
from .compare_numbers import WEIGHTS, Contrast, Planes, find
from .compare_report import Account, Pictures, check_folder, write_account

Named = tuple[str, Planes]
"""What messages call a picture, and its planes."""


@dataclass(frozen=True, kw_only=True)
class PicturesOrder:
    """Which files to compare."""

    picture: str
    reference: str
    out: str = ""
    """The folder for a report; '' writes none."""
    fail_under: float | None = None
    """[dB] of the glass, or of everything where nothing says where the glass is."""
    overwrite: bool = False


def compare_pictures(order: PicturesOrder) -> Account:
    """Measure how far one picture is from another.

    AOVs are the picture's; where only the reference says where the glass is, its mask is taken.

    Raises:
        UsageError: the sizes differ, a file is no picture, or the folder has something else in it.
        ImageError: a file cannot be read, or the report cannot be written.
    """
    if order.out:
        check_folder(order.out, overwrite=order.overwrite)
    named = (order.picture, read_planes(order.picture)), (order.reference, read_planes(order.reference))
    account, contrast = _account(*named, order.fail_under)
    if order.out:
        write_account(account, Pictures(None, None, contrast), order.out)
    return account


def compare_planes(picture: Named, reference: Named) -> Account:
    """The same of planes in memory.

    Raises:
        UsageError: the sizes differ, or a plane holds NaN.
    """
    return _account(picture, reference, None)[0]


def _account(one: Named, other: Named, fail_under: float | None) -> tuple[Account, Contrast]:
    (picture_name, picture), (reference_name, reference) = one, other
    contrast = Contrast(picture, reference, (picture_name, reference_name))
    planes = {name: plane for name, plane in picture.items() if name in ("beauty", "mask", "confidence", *WEIGHTS)}
    if "mask" not in planes and "mask" in reference:
        planes["mask"] = reference["mask"]
    height, width = contrast.test.shape[:2]
    account = Account(
        picture=picture_name, reference=reference_name, size=(width, height),
        findings=find(contrast, planes, {}), fail_under=fail_under,
    )  # fmt: skip
    return account, contrast
