"""Exact truth of moving meshes in a picture: labels, flow, occlusion, visible joints.

Pixel centres are rasterised (`torchcss.vision.rasterise`): every pixel that sees a mesh
knows the triangle and the point in it. The flow of the pixel is that of this point, carried to the
next frame by its triangle. There the point is hidden if its triangle looks away, if it leaves the
image, or if a surface lies before it; what lies there is looked up among the four nearest of the
rays of a picture of twice the size, so that the outline of whatever covers it is exact to half a
pixel. Where no mesh is seen, the flow is 0, and hidden is what a mesh covers next.

Make a `MeshTruth` of the meshes' triangles once; `labels` of the corners of every frame; `flow` and
`joints` of the labels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from torchcss.body.model import BodyModel
from torchcss.studies.render.character import distance_to_parts
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import doubled_areas, interpolate, rasterise

_SKIN_DEEP = 0.005
"""Metres that a point may lie behind the surface that the picture has there and count as seen."""

_JOINT_DEEP = 0.2
"""Metres that the surface may lie before a joint centre that it covers as its own part."""


class Labels(NamedTuple):
    """What is seen at every pixel centre, and what is needed to look for a point later.

    Attributes:
        face: Triangle, -1 where there is none.
        barycentric: Weights of its corners.
        part: Part of the tracked body, -1 where it is none.
        depth: Depth of the surface, metres; `inf` where there is none.
        fine_depth: Depths in a picture of twice the size.
        world: Corners of the meshes.
        facing: Whether a triangle looks towards the camera.
    """

    face: Int[Tensor, "h w"]
    barycentric: Float[Tensor, "h w 3"]
    part: Int[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    fine_depth: Float[Tensor, "2h 2w"]
    world: Float[Tensor, "v 3"]
    facing: Bool[Tensor, " f"]


class MeshTruth:
    """Labels, flow and visibility of meshes whose corners move.

    Args:
        camera: Who looks.
        faces: Corner indices of all triangles, anticlockwise from outside.
        part: Part of the tracked body that every triangle belongs to, -1 for what only hides.
        own: Which parts may be seen before a joint that still counts as visible.
    """

    def __init__(
        self,
        camera: Camera,
        faces: Int[Tensor, "f 3"],
        part: Int[Tensor, " f"],
        own: Bool[Tensor, "j parts"],
    ) -> None:
        self.camera, self.faces, self.part, self.own = camera, faces, part, own
        self.width, self.height = camera.image_size_wh

    def labels(self, world: Float[Tensor, "v 3"]) -> Labels:
        """Rasterise posed meshes, at the picture's size and at twice the size.

        Args:
            world: Corners, metres.
        """
        uv, depth, valid = self.camera.project(world)
        seen = rasterise(uv, depth, self.faces, self.height, self.width, valid=valid)
        part = torch.where(seen.face >= 0, self.part[seen.face.clamp(min=0)], -1)
        fine = rasterise(
            (uv + 0.5) * 2 - 0.5, depth, self.faces, 2 * self.height, 2 * self.width, valid=valid
        )
        facing = doubled_areas(uv, self.faces) < 0
        return Labels(seen.face, seen.barycentric, part, seen.depth, fine.depth, world, facing)

    def flow(self, now: Labels, after: Labels) -> tuple[Tensor, Tensor]:
        """Motion of every pixel to the next frame, and whether it is hidden there.

        Args:
            now: Labels of this frame.
            after: Labels of the next one.

        Returns:
            Flow in pixels `[h w 2]`, and a mask `[h w]`.
        """
        flow = now.depth.new_zeros(self.height, self.width, 2)
        occluded = after.part >= 0
        row, column = (now.part >= 0).nonzero(as_tuple=True)
        face = now.face[row, column]
        points = interpolate(after.world, self.faces, face, now.barycentric[row, column])
        uv, depth, valid = self.camera.project(points)
        here = torch.stack([column, row], -1).to(uv)
        flow[row, column] = uv - here
        outside = ~valid | ~self.camera.inside_image(uv)
        hidden = (
            outside | ~after.facing[face] | (depth > self._depth_around(after, uv) + _SKIN_DEEP)
        )
        occluded[row, column] = hidden
        return flow, occluded

    def joints(
        self, labels: Labels, joints: Float[Tensor, "j 3"]
    ) -> tuple[Float[Tensor, "j 2"], Bool[Tensor, " j"], Bool[Tensor, " j"]]:
        """Projections of joints, whether they are visible, and whether they are in the image.

        Visible means that the first surface on the line of sight is the joint's own part.

        Args:
            labels: Labels of the frame.
            joints: Joint centres, world frame, metres.
        """
        uv, depth, valid = self.camera.project(joints)
        inside = valid & self.camera.inside_image(uv)
        visible = torch.zeros_like(inside)
        for index in inside.nonzero()[:, 0].tolist():
            u, v = (int(x) for x in uv[index].round().tolist())
            # A joint on the outline, such as the top of the head, may lie a hair beside its limb.
            rows, columns = slice(max(v - 1, 0), v + 2), slice(max(u - 1, 0), u + 2)
            part, surface = labels.part[rows, columns], labels.depth[rows, columns]
            own = (part >= 0) & self.own[index][part.clamp(min=0)]
            visible[index] = bool((own & (surface > depth[index] - _JOINT_DEEP)).any())
        return uv, visible, inside

    def _depth_around(self, labels: Labels, uv: Tensor) -> Tensor:
        """The farthest of the four surfaces around a point of the picture, half a pixel apart."""
        # Beyond the border the outermost surfaces go on.
        fine = functional.pad(labels.fine_depth[None], (1, 1, 1, 1), mode="replicate")
        farthest = functional.max_pool2d(fine, 2, stride=1)[0]
        column, row = ((uv + 0.5) * 2 + 0.5).floor().long().unbind(-1)
        return farthest[row.clamp(0, 2 * self.height), column.clamp(0, 2 * self.width)]


def joints_own_parts(body: BodyModel) -> Bool[Tensor, "j parts"]:
    """Which parts hold a joint centre inside them, or within 2 cm, in the rest pose.

    Args:
        body: The body.
    """
    pose = body.pose(body.rest)
    rotation, centre = body.part_poses(pose)
    local = (pose.joints[None] - centre[:, None]) @ rotation
    return (distance_to_parts(body.part_shape, local) < 0.02).T
