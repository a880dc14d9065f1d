"""Write the textures of the samples: `python usd_samples/make_textures.py`. The same files every time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

F64 = NDArray[np.float64]
FOLDER = Path(__file__).parent / "good" / "textures"


def main() -> None:
    """Write every texture."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    _write("wood.png", _encoded(wood()))
    _write("checker.png", _encoded(checker()))
    _write("room.png", _encoded(room()))
    _write("stripes.png", _encoded(stripes()))
    _write("ripples.png", ripples()[..., None])
    _write("newspaper.png", newspaper()[..., None])
    _write("studio.exr", studio())


def wood(size: int = 512, planks: int = 4) -> F64:
    """Linear colours of seamless planks with the grain along u."""
    grain = _cloud(size, 0.9, 12.0, seed=1) + 0.6 * _cloud(size, 2.2, 60.0, seed=2)
    grain = grain / np.abs(grain).max()
    rows, columns = np.mgrid[0:size, 0:size]
    plank = rows * planks // size
    height = size // planks
    tone = np.array([0.02, -0.10, 0.10, -0.03])[plank % 4]
    shift = np.array([0, 190, 330, 90])[plank % 4]
    joint = np.minimum(rows % height, height - 1 - rows % height) < 1
    joint |= np.minimum((columns + shift) % size, size - 1 - (columns + shift) % size) < 1
    mix = np.clip(0.5 + 0.42 * grain[rows, (columns + shift) % size] + tone, 0.0, 1.0)[..., None]
    color = (1.0 - mix) * np.array([0.13, 0.055, 0.022]) + mix * np.array([0.46, 0.25, 0.11])
    return np.where(joint[..., None], 0.45 * color, color)


def checker(size: int = 256, squares: int = 4) -> F64:
    """Linear colours of a checker with an even number of squares, so that it repeats."""
    rows, columns = np.mgrid[0:size, 0:size] * squares // size
    odd = ((rows + columns) % 2)[..., None]
    return np.where(odd == 1, np.array([0.78, 0.75, 0.70]), np.array([0.045, 0.055, 0.07]))


def room(face: int = 192, squares: int = 6) -> F64:
    """Linear colours of the six walls of a room, three beside each other in two rows, each its own checker."""
    pairs = [
        ((0.75, 0.70, 0.60), (0.10, 0.11, 0.14)),  # back
        ((0.60, 0.60, 0.60), (0.20, 0.20, 0.20)),  # front, behind the camera
        ((0.80, 0.16, 0.10), (0.22, 0.03, 0.03)),  # left
        ((0.12, 0.42, 0.72), (0.02, 0.07, 0.20)),  # right
        ((0.66, 0.42, 0.12), (0.16, 0.08, 0.03)),  # floor
        ((0.80, 0.88, 0.95), (0.35, 0.45, 0.55)),  # ceiling
    ]
    rows, columns = np.mgrid[0:face, 0:face] * squares // face
    odd = ((rows + columns) % 2)[..., None]
    walls = [np.where(odd == 1, np.array(dark), np.array(light)) for light, dark in pairs]
    return np.vstack([np.hstack(walls[:3]), np.hstack(walls[3:])])


def stripes(size: int = 256) -> F64:
    """Linear colours of slanted candy stripes, seamless both ways."""
    palette = np.array([[0.80, 0.75, 0.66], [0.62, 0.07, 0.05], [0.80, 0.75, 0.66], [0.02, 0.16, 0.30]])
    sub = (np.arange(size * 4) + 0.5) / (size * 4)  # four by four samples in each texel
    band = ((sub[:, None] + sub[None, :]) * 8.0 % 4.0).astype(int)
    return palette[band].reshape(size, 4, size, 4, 3).mean(axis=(1, 3))


def ripples(size: int = 256) -> F64:
    """Thickness between 0 and 1: rings around the middle of the picture that die away towards its edge."""
    at = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    radius = np.hypot(at[:, None], at[None, :])
    wave = 0.5 - 0.5 * np.cos(2.0 * np.pi * 4.0 * radius)
    fade = np.clip(1.15 - radius, 0.0, 1.0)
    return np.clip(0.08 + 0.92 * wave * fade, 0.0, 1.0)


def newspaper(width: int = 1200) -> F64:
    """sRGB values 0 .. 1 of a front page: title, headline and four columns, in OpenImageIO's own letters."""
    height = width * 2 // 3
    page = oiio.ImageBuf(oiio.ImageSpec(width, height, 1, "float"))
    oiio.ImageBufAlgo.fill(page, (0.86,))
    ink = (0.07,)
    for title, y, size in (("THE DAILY LENS", 100, 92), ("Light bends on its way through glass", 190, 54)):
        oiio.ImageBufAlgo.render_text(page, width // 2, y, title, size, "", ink, "center", "baseline")
    for y in (118, 124, 214):
        oiio.ImageBufAlgo.render_box(page, 40, y, width - 40, y + 1, ink, True)
    text = (
        "A ray that enters glass is slower there and so it turns towards the normal said Snell in Leiden. How much it "
        "turns the index tells. Where it leaves the glass it turns back unless it comes too flat in which case all of "
        "it is mirrored and stays within. Two round faces make a lens that gathers the light of a window in one spot "
        "and shows small letters large to whoever looks through it from above. Red turns less than blue. "
    )
    story = text.split()
    at = 0
    for column in range(4):
        for line in range(20):
            words: list[str] = []
            while len(" ".join([*words, story[at % len(story)]])) < 27:
                words.append(story[at % len(story)])
                at += 1
            x, y = 40 + column * 285, 252 + line * 27
            oiio.ImageBufAlgo.render_text(page, x, y, " ".join(words), 20, "", ink)
    return np.asarray(page.get_pixels(oiio.FLOAT), dtype=np.float64)[..., 0]


def studio(width: int = 256) -> F64:
    """Radiance of a photographer's studio, latlong, the middle looks along +Z: soft walls and two softboxes."""
    height = width // 2
    azimuth = (np.arange(width) + 0.5) / width * 360.0 - 180.0
    altitude = (90.0 - (np.arange(height) + 0.5) / height * 180.0)[:, None]
    up = np.clip(altitude / 90.0 * 0.5 + 0.5, 0.0, 1.0)[..., None]
    picture = (1.0 - up) * np.array([0.16, 0.12, 0.10]) + up * np.array([0.42, 0.50, 0.62])
    boxes = [  # centre azimuth and altitude, half width and height [degrees], radiance
        (-60.0, 40.0, 34.0, 22.0, (2.4, 2.2, 1.9)),
        (65.0, 32.0, 16.0, 26.0, (1.5, 1.8, 2.2)),
    ]
    for x, y, half_width, half_height, radiance in boxes:
        away = np.abs((azimuth - x + 180.0) % 360.0 - 180.0)
        inside = _edge(away, half_width) * _edge(np.abs(altitude - y), half_height)
        picture = picture + inside[..., None] * np.array(radiance)
    return picture


def _edge(distance: F64, half: float) -> F64:
    """1 inside, 0 outside, with three degrees between."""
    return np.clip((half - distance) / 3.0 + 0.5, 0.0, 1.0)


def _cloud(size: int, along: float, across: float, seed: int) -> F64:
    """Periodic noise in -1 .. 1, whose waves per width are at most about `along` (columns) and `across` (rows)."""
    noise = np.random.default_rng(seed).standard_normal((size, size))
    frequency = np.fft.fftfreq(size, 1.0 / size)
    envelope = np.exp(-0.5 * ((frequency[:, None] / across) ** 2 + (frequency[None, :] / along) ** 2))
    smooth = np.fft.ifft2(np.fft.fft2(noise) * envelope).real
    smooth -= smooth.mean()
    return smooth / np.abs(smooth).max()


def _encoded(linear: F64) -> F64:
    """sRGB values 0 .. 1 (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def _write(name: str, pixels: F64) -> None:
    """8 bits for a .png, half floats for an .exr."""
    height, width, channels = pixels.shape
    half = name.endswith(".exr")
    spec = oiio.ImageSpec(width, height, channels, "half" if half else "uint8")
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "2000:01:01 00:00:00")  # else an .exr would differ from run to run
    if not half:
        pixels = np.round(np.clip(pixels, 0.0, 1.0) * 255.0) / 255.0
    buffer = oiio.ImageBuf(spec)
    buffer.set_pixels(oiio.ROI.All, pixels.astype(np.float32))
    if not buffer.write(str(FOLDER / name)):
        raise OSError(f"{FOLDER / name}: {buffer.geterror()}")


if __name__ == "__main__":
    main()
