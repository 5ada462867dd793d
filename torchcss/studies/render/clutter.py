"""Painted backdrops to film before: a room of hard edges in uneven light, and a dark curtain."""

from __future__ import annotations

from copy import copy

import torch
from torch import Tensor
from torch.nn import functional

from torchcss.studies.render.renderer import Picture, to_bytes, value_noise

PILLAR_WIDTH = 0.055
"""Of the pillar, as a share of the picture's width."""


def clutter_background(
    height: int, width: int, *, generator: torch.Generator, pillar: float | None = None
) -> Picture:
    """Paint a cluttered and unevenly lit room: what an edge tracker finds hardest.

    A wall with posters, shelves of books, a window with blinds, a bright pillar, a floor of boards
    and boxes on it: hard edges of every direction and length, many of them parallel pairs like
    those of a limb, over a light that falls off across the picture. Where things stand and how
    they look is random; the kinds of things are the same for every seed.

    Args:
        height: Rows.
        width: Columns.
        generator: Source of randomness.
        pillar: Left side of the pillar as a share of the width; None: random, near the middle.
    """
    painter = _Painter(2 * height, 2 * width, generator)  # twice the size, averaged at the end
    aspect, floor = width / height, painter.uniform(0.78, 0.86)
    painter.wall(floor)
    painter.window(painter.uniform(0.0, 0.1) * aspect, painter.uniform(0.06, 0.14), aspect / 4)
    painter.poster(painter.uniform(0.36, 0.42) * aspect, painter.uniform(0.08, 0.16))
    painter.poster(painter.uniform(0.10, 0.22) * aspect, painter.uniform(0.54, 0.58))
    painter.shelves(painter.uniform(0.66, 0.70) * aspect, aspect * 0.97, floor)
    pillar = painter.uniform(0.56, 0.60) if pillar is None else pillar
    painter.pillar(pillar * aspect, PILLAR_WIDTH * aspect)
    for left in (0.03, 0.30, 0.44):
        painter.carton(painter.uniform(left, left + 0.08) * aspect, painter.uniform(0.9, 0.97))
    return painter.develop()


def dark_background(height: int, width: int, *, generator: torch.Generator) -> Picture:
    """Paint a dark curtain.

    Args:
        height: Rows.
        width: Columns.
        generator: Source of the folds.
    """
    folds = value_noise(height, width, cell=width / 16, generator=generator)
    cloth = 0.035 * (1 + 0.25 * folds[..., None])
    return to_bytes(255 * cloth * cloth.new_tensor([0.95, 0.95, 1.15]))


class _Painter:
    """A canvas of light `[3, h, w]`; lengths are in image heights, so a picture scales whole."""

    def __init__(self, rows: int, columns: int, generator: torch.Generator) -> None:
        self.generator = generator
        self.y = ((torch.arange(rows) + 0.5) / rows)[:, None]
        self.x = ((torch.arange(columns) + 0.5) / rows)[None]
        self.canvas = torch.zeros(3, rows, columns)

    def uniform(self, low: float, high: float) -> float:
        draw = torch.rand((), generator=self.generator)
        return low + (high - low) * float(draw)

    def colour(self, low: float, high: float, saturation: float) -> Tensor:
        """A random colour of lightness between `low` and `high`."""
        hue = torch.rand(3, generator=self.generator)
        level = self.uniform(low, high)
        return (level * (1 + saturation * (hue - hue.mean()))).clamp(0, 1)

    def brown(self, low: float, high: float) -> Tensor:
        """A random colour of wood or cardboard."""
        warmth = self.uniform(0.1, 0.4)
        tone = self.canvas.new_tensor([1 + warmth, 1.0, 1 - warmth])
        return self.uniform(low, high) * tone

    def fill(self, inside: Tensor, colour: Tensor, shading: Tensor | float = 1.0) -> None:
        """Paint `colour` times `shading` where `inside`."""
        shading = torch.as_tensor(shading)
        paint = colour[:, None, None] * shading
        self.canvas.copy_(torch.where(inside, paint, self.canvas))

    def darken(self, inside: Tensor, factor: float) -> None:
        self.canvas.copy_(torch.where(inside, factor * self.canvas, self.canvas))

    def near(self, left: float, right: float, top: float, bottom: float) -> _Painter:
        """Who paints what is in a box of the same canvas: as quick as it is small."""
        rows, columns = (
            slice(*torch.searchsorted(axis.flatten(), axis.new_tensor(ends)).tolist())
            for axis, ends in ((self.y, (top, bottom)), (self.x, (left, right)))
        )
        other = copy(self)
        other.y, other.x = self.y[rows], self.x[:, columns]
        other.canvas = self.canvas[:, rows, columns]
        return other

    def box(self, left: float, right: float, top: float, bottom: float) -> Tensor:
        return (self.x > left) & (self.x < right) & (self.y > top) & (self.y < bottom)

    def wall(self, floor: float) -> None:
        rows, columns = self.canvas.shape[1:]
        stain = value_noise(rows, columns, cell=rows / 3, octaves=4, generator=self.generator)
        everywhere = torch.ones_like(stain, dtype=torch.bool)
        self.fill(everywhere, self.colour(0.40, 0.5, 0.25), 1 + 0.05 * stain)
        # Boards that run away from the viewer: their joints meet at a point above the floor.
        board = (self.x - self.x.mean()) / (self.y - floor + 0.35).clamp_min(0.1) * 5
        tone = 1 + 0.25 * (board.floor() * 12.9898).sin()
        joint = torch.where((board - board.floor()) < 0.05, 0.45, 1.0)
        self.fill(self.y.expand_as(stain) > floor, self.brown(0.2, 0.3), tone * joint)
        self.fill(self.box(-1, 9, floor - 0.03, floor), self.colour(0.5, 0.6, 0.1))
        self.fill(self.box(-1, 9, floor, floor + 0.006), self.colour(0.05, 0.06, 0.1))

    def window(self, left: float, top: float, size: float) -> None:
        right, bottom = left + size, top + 0.36
        here = self.near(left, right, top, bottom)
        here.fill(here.box(left, right, top, bottom), self.colour(0.6, 0.7, 0.1))
        slats = torch.where((here.y * self.uniform(28, 36)) % 1 < 0.3, 0.45, 1.0)
        pane = here.box(left + 0.015, right - 0.015, top + 0.015, bottom - 0.015)
        sky = 1 - 0.3 * (here.y - top)
        here.fill(pane, self.colour(0.75, 0.85, 0.1), slats * sky)
        middle = (left + right) / 2
        here.fill(here.box(middle - 0.008, middle + 0.008, top, bottom), self.colour(0.3, 0.4, 0.1))

    def poster(self, left: float, top: float) -> None:
        wide, high = self.uniform(0.16, 0.22), self.uniform(0.2, 0.26)
        tilt = self.uniform(-0.08, 0.08)
        here = self.near(left - 0.04, left + wide + 0.04, top - 0.04, top + high + 0.04)
        across, down = here.x - left + tilt * (here.y - top), here.y - top - tilt * (here.x - left)
        sheet = (across > 0) & (across < wide) & (down > 0) & (down < high)
        shadow = (across > 0.008) & (across < wide + 0.008) & (down > 0.008) & (down < high + 0.008)
        here.darken(shadow, 0.6)
        here.fill(sheet, self.colour(0.7, 0.85, 0.3))
        edge = 0.014
        inner = (across > edge) & (across < wide - edge) & (down > edge) & (down < high - edge)
        here.fill(inner, self.colour(0.25, 0.45, 1.2))
        slope, period = self.uniform(-1.5, 1.5), self.uniform(0.04, 0.07)
        stripes = ((across + slope * down) / period) % 1 < 0.45
        here.fill(inner & stripes, self.colour(0.4, 0.7, 1.0))
        reach = ((across - wide / 2) ** 2 + (down - high / 2.4) ** 2).sqrt()
        here.fill(inner & (reach < wide * 0.3), self.colour(0.15, 0.8, 0.8))
        here.fill(inner & (reach < wide * 0.15), self.colour(0.15, 0.8, 0.8))

    def shelves(self, left: float, right: float, floor: float) -> None:
        top, count = 0.12, 3
        pitch = (floor - 0.03 - top) / count
        wood = self.brown(0.22, 0.34)
        self.fill(self.box(left, right, top, floor + 0.02), wood * 0.45)
        for shelf in range(count):
            base, x = top + (shelf + 1) * pitch - 0.015, left + 0.02
            while x < right - 0.07:
                thick = self.uniform(0.014, 0.042)
                lean = self.uniform(-0.12, 0.12) if self.uniform(0, 1) < 0.2 else 0.0
                high = pitch * self.uniform(0.5, 0.85)
                book = self.near(x - pitch / 8, x + thick + pitch / 8, base - high, base)
                across = book.x - x + lean * (book.y - base)
                spine = (across > 0) & (across < thick) & (book.y > base - high) & (book.y < base)
                # Rounded backs: lit from the left.
                book.fill(spine, self.colour(0.12, 0.6, 1.0), 1.15 - 0.5 * across / thick)
                label = self.uniform(0.15, 0.7)
                band = spine & ((book.y - base + high * label).abs() < 0.012)
                book.fill(band, self.colour(0.5, 0.8, 0.4))
                x += thick + (0.03 if self.uniform(0, 1) < 0.15 else 0.002)
            self.fill(self.box(left, right, base, base + 0.02), wood)
        for side in (left, right - 0.018):
            self.fill(self.box(side, side + 0.018, top - 0.01, floor + 0.02), wood * 1.2)
        self.fill(self.box(left, right, top - 0.015, top), wood * 1.2)

    def pillar(self, left: float, wide: float) -> None:
        here = self.near(left, left + 1.5 * wide, 0, 0.96)
        shadow = here.box(left + wide, left + 1.5 * wide, 0, 0.95)
        here.darken(shadow, 0.65)
        round_ = ((here.x - left) / wide * 2 - 0.8).clamp(-1, 1.2)
        here.fill(
            here.box(left, left + wide, -1, 0.96), self.colour(0.8, 0.85, 0.1), 1 - 0.4 * round_**2
        )

    def carton(self, left: float, bottom: float) -> None:
        wide, high, deep = self.uniform(0.16, 0.24), self.uniform(0.1, 0.2), 0.045
        top = bottom - high
        here = self.near(left - 0.01, left + wide + deep + 0.01, top - deep - 0.01, bottom + 0.01)
        brown = self.brown(0.35, 0.5)
        here.fill(here.box(left, left + wide, top, bottom), brown)
        across = (here.x - left - wide) / deep
        side = (across > 0) & (across < 1) & (here.y > top - deep * across)
        here.fill(side & (here.y < bottom - deep * across), brown * 0.55)
        lift = (top - here.y) / deep
        lid = (lift > 0) & (lift < 1) & (here.x > left + deep * lift)
        here.fill(lid & (here.x < left + wide + deep * lift), brown * 1.3)
        tape = here.x - left - 0.45 * wide
        here.fill((tape > 0) & (tape < 0.03) & (here.y > top) & (here.y < bottom), brown * 1.5)
        print_ = here.box(left + 0.015, left + 0.06, bottom - 0.05, bottom - 0.015)
        here.fill(print_ & ((here.y * 110) % 1 < 0.5), brown * 0.3)

    def develop(self) -> Picture:
        """Light the room unevenly, average to the final size, and round."""
        rows, columns = self.canvas.shape[1:]
        blotch = value_noise(rows, columns, cell=rows / 2, octaves=2, generator=self.generator)
        grain = value_noise(rows, columns, cell=rows / 60, octaves=2, generator=self.generator)
        x0, y0 = self.uniform(0.2, 0.5) * columns / rows, self.uniform(0.2, 0.4)
        pool = torch.exp(-(((self.x - x0) / 0.7) ** 2) - ((self.y - y0) / 0.55) ** 2)
        light = (0.5 + 0.62 * pool) * (1 + 0.06 * blotch) * (1 + 0.02 * grain)
        picture = functional.avg_pool2d((self.canvas * light)[None].clamp(0, 1), 2)[0]
        return to_bytes(255 * picture.permute(1, 2, 0))
