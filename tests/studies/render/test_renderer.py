"""The renderer against a slow twin, against analytic surfaces, and on awkward input."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from torchcss.errors import ShapeError
from torchcss.studies.render.clutter import clutter_background
from torchcss.studies.render.renderer import (
    READ,
    SHOT,
    Lighting,
    Mesh,
    add_sensor_noise,
    random_texture,
    render_meshes,
    value_noise,
)
from torchcss.studies.render.scene import look_at
from torchcss.vision import rasterise as rasterise_module
from torchcss.vision.rasterise import (
    interpolate,
    join_faces,
    nearest_faces,
    rasterise,
    vertex_normals,
)

EYE = torch.tensor([0.0, 0.0, 3.0])


def sphere(around=24, along=12, dtype=torch.float32):
    """Vertices and outward faces of a unit sphere."""
    polar = torch.linspace(0, math.pi, along + 1, dtype=dtype)[1:-1]
    azimuth = torch.arange(around, dtype=dtype) * (2 * math.pi / around)
    t, a = torch.meshgrid(polar, azimuth, indexing="ij")
    ring = torch.stack((t.sin() * a.cos(), t.cos(), t.sin() * a.sin()), -1).reshape(-1, 3)
    vertices = torch.cat((ring, ring.new_tensor([[0, 1, 0], [0, -1, 0]])))
    faces, rows = [], along - 1
    for j in range(around):
        k = (j + 1) % around
        for i in range(rows - 1):
            a, b, c, d = i * around + j, i * around + k, (i + 1) * around + j, (i + 1) * around + k
            faces += [[a, b, c], [b, d, c]]
        last = (rows - 1) * around
        faces += [[rows * around, k, j], [rows * around + 1, last + j, last + k]]
    return vertices, torch.tensor(faces)


def camera(height, width, focal):
    """A camera at `EYE` that looks along -Z of the world."""
    return look_at(EYE.tolist(), (0, 0, 0), focal_px=focal, image_size_wh=(width, height))


def soup(generator, size=40.0, dtype=torch.float32):
    """Random triangles, many of them partly or wholly out of the image."""
    count = 60
    centre = torch.rand(count, 1, 2, generator=generator) * 80 - 20
    uv = centre + size * (torch.rand(count, 3, 2, generator=generator) - 0.5)
    depth = 1 + 3 * torch.rand(count, 3, generator=generator)
    faces = torch.arange(3 * count).view(count, 3)
    return uv.view(-1, 2).to(dtype), depth.view(-1).to(dtype), faces


def rasterise_slowly(uv, depth, faces, height, width):
    """Every pixel against every triangle, in float64."""
    x = torch.arange(width).double()
    y = torch.arange(height).double()
    pixel = torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], -1)
    face = torch.full((height, width), -1)
    nearest = torch.full((height, width), torch.inf).double()
    weights = torch.zeros(height, width, 3).double()
    for index, corner in enumerate(faces):
        a, b, c = uv[corner].double()
        z = depth[corner].double()

        def cross(p, q):
            return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]

        area = cross(b - a, c - a)
        part = torch.stack(
            (
                cross(b - pixel, c - pixel),
                cross(c - pixel, a - pixel),
                cross(a - pixel, b - pixel),
            ),
            -1,
        )
        part = part / area
        inside = (part >= 0).all(-1)
        here = 1 / (part / z).sum(-1)
        closer = inside & (here < nearest)
        nearest = torch.where(closer, here, nearest)
        weights = torch.where(closer[..., None], (part / z) * here[..., None], weights)
        face[closer] = index
    return face, weights, nearest


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [4.0, 40.0, 400.0])
def test_equals_the_slow_twin(generator, dtype, size):
    uv, depth, faces = soup(generator, size=size, dtype=dtype)
    fast = rasterise(uv, depth, faces, 37, 43)
    face, weights, nearest = rasterise_slowly(uv, depth, faces, 37, 43)
    torch.testing.assert_close(fast.face, face)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-10
    torch.testing.assert_close(fast.barycentric.double(), weights, atol=tolerance, rtol=0)
    torch.testing.assert_close(fast.depth.double(), nearest, atol=tolerance, rtol=tolerance)
    assert fast.depth.dtype == fast.barycentric.dtype == dtype


def test_small_chunks_change_nothing(generator, monkeypatch):
    uv, depth, faces = soup(generator)
    whole = rasterise(uv, depth, faces, 50, 40)
    monkeypatch.setattr(rasterise_module, "_PIXELS_AT_ONCE", 37)
    for a, b in zip(whole, rasterise(uv, depth, faces, 50, 40), strict=True):
        assert torch.equal(a, b)


def test_many_pictures_at_once_are_those_one_by_one(generator):
    """What lies outside of one picture must not show up in the next."""
    uv, depth, faces = soup(generator, size=40.0)
    many = torch.stack([uv + shift for shift in (0.0, -30.0, 25.0, 1e4)])
    depths = depth + torch.tensor([[0.0], [1.0], [-1.0], [0.0]])
    valid = torch.rand(depths.shape, generator=generator) > 0.1
    found = nearest_faces(many, depths, faces, 37, 43, valid=valid)
    for seen, places, behind, use in zip(found, many, depths, valid, strict=True):
        assert torch.equal(seen, rasterise(places, behind, faces, 37, 43, valid=use).face)
    none = nearest_faces(many[:0], depths[:0], faces, 3, 4, valid=valid[:0])
    assert none.shape == (0, 3, 4)
    assert (nearest_faces(many, depths, faces[:0], 3, 4, valid=valid) == -1).all()
    with pytest.raises(ShapeError, match="valid"):
        nearest_faces(many, depths, faces, 3, 4, valid=valid[:1])


def test_order_of_faces_and_corners_does_not_matter(generator):
    uv, depth, faces = soup(generator)
    order = torch.randperm(len(faces), generator=generator)
    first = rasterise(uv, depth, faces, 50, 40)
    second = rasterise(uv, depth, faces[order].roll(1, -1).flip(-1), 50, 40)
    named = torch.where(second.face >= 0, order[second.face.clamp_min(0)], -1)
    assert torch.equal(first.face, named)
    torch.testing.assert_close(first.depth, second.depth)


def test_neighbours_cover_every_pixel_exactly_once(generator):
    # A jittered grid of triangles, corners also exactly on pixel centres and rows.
    n, step = 9, 5
    grid = torch.stack(torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij"), -1)
    uv = (grid.reshape(-1, 2) * step).float()
    inner = ((grid > 0) & (grid < n - 1)).all(-1).reshape(-1, 1)
    jitter = torch.rand(n * n, 2, generator=generator) * 4 - 2
    jitter[::3] = jitter[::3].round()
    uv = uv + inner * jitter
    corner = (torch.arange(n - 1)[:, None] * n + torch.arange(n - 1)).reshape(-1, 1)
    faces = torch.cat((corner + torch.tensor([0, 1, n]), corner + torch.tensor([1, n + 1, n])), 0)
    size = (n - 1) * step  # the last row and column belong to what would come after
    count = torch.zeros(size, size)
    for face in faces:
        count += rasterise(uv, torch.ones(n * n), face[None], size, size).face >= 0
    assert torch.equal(count, torch.ones(size, size))


def test_depth_of_a_slanted_plane_is_exact():
    corners = torch.tensor([[-9.0, -9, 1], [9, -9, 1], [9, 9, -8], [-9, 9, -8]]).double()
    uv, depth, _ = camera(40, 60, 50.0).project(corners)
    fragments = rasterise(uv, depth, torch.tensor([[0, 1, 2], [0, 2, 3]]), 40, 60)
    v = torch.arange(40).double()[:, None].expand(40, 60)
    # The plane y + 2 z = -7, met by the ray (., (19.5 - v) / 50, -1) from z = 3.
    expected = 13 / (2 - (19.5 - v) / 50)
    seen = fragments.face >= 0
    assert seen.float().mean() > 0.9
    torch.testing.assert_close(fragments.depth[seen], expected[seen], rtol=1e-12, atol=0)
    assert torch.isinf(fragments.depth[~seen]).all()
    world = interpolate(
        corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), fragments.face[seen],
        fragments.barycentric[seen],
    )  # fmt: skip
    torch.testing.assert_close(3 - world[:, 2], fragments.depth[seen])


def test_a_sphere_has_no_holes_and_the_right_depth():
    vertices, faces = sphere(96, 48, torch.float64)
    uv, depth, valid = camera(120, 160, 150.0).project(vertices)
    fragments = rasterise(uv, depth, faces, 120, 160, valid=valid)
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    ray = torch.stack(((x - 79.5) / 150, (59.5 - y) / 150, -torch.ones_like(x)), -1).double()
    middle = -3 * ray[..., 2]
    square = (ray**2).sum(-1)
    root = middle**2 - square * 8
    hit = root > 0
    expected = (middle - root.clamp_min(0).sqrt()) / square
    inner = root > 0.05
    assert (fragments.face[inner] >= 0).all()
    assert (fragments.face[~hit] == -1).all()
    assert (fragments.depth[inner] - expected[inner]).abs().max() < 5e-3


def test_what_is_behind_the_camera_or_broken_is_left_out():
    uv = torch.tensor([[0.0, 0], [30, 0], [0, 30], [torch.nan, 3], [torch.inf, 3]])
    depth = torch.tensor([1.0, 1, 1, 1, 1])
    whole = torch.tensor([[0, 1, 2]])
    assert (rasterise(uv, depth, whole, 10, 10).face == 0).all()
    for bad in (-1.0, 0.0, torch.nan, torch.inf):
        spoilt = torch.tensor([1.0, bad, 1, 1, 1])
        fragments = rasterise(uv, spoilt, whole, 10, 10)
        assert (fragments.face == -1).all()
        assert (fragments.barycentric == 0).all()
        assert torch.isinf(fragments.depth).all()
    for broken in (3, 4):
        fragments = rasterise(uv, depth, torch.tensor([[0, 1, broken], [0, 1, 2]]), 10, 10)
        assert (fragments.face == 1).all()
    valid = torch.tensor([True, False, True, True, True])
    assert (rasterise(uv, depth, whole, 10, 10, valid=valid).face == -1).all()


@pytest.mark.parametrize("reach", [1e3, 1e6, 1e8, 1e12, 1e30])
def test_corners_far_outside_are_clipped(reach):
    uv = torch.tensor([[-reach, -reach], [reach, -reach], [0.0, reach], [-reach, 0], [reach, 1e-3]])
    depth = torch.tensor([1.0, 2.0, 3.0, 1e-5, 1e5])
    fragments = rasterise(uv, depth, torch.tensor([[0, 1, 2], [3, 4, 0]]), 21, 17)
    assert torch.isfinite(fragments.barycentric).all()
    assert not torch.isnan(fragments.depth).any()
    if reach < 1e9:
        assert (fragments.face >= 0).all()
        torch.testing.assert_close(fragments.barycentric.sum(-1), torch.ones(21, 17))
    else:
        assert (fragments.face == -1).all()


def test_hairlines_between_far_corners_stay_finite(generator):
    # So thin and long that rounding alone decides the barycentric coordinates.
    count = 1000
    angle = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    arm = 8e8 * torch.stack((angle.cos(), angle.sin()), -1)
    middle = torch.randint(0, 20, (count, 2), generator=generator)
    nudge = 1e-7 * torch.randn(count, 2, generator=generator, dtype=torch.float64)
    uv = torch.stack((middle + arm, middle - arm, middle + arm / 3 + nudge), 1)
    depth = 0.5 + torch.rand(3, generator=generator, dtype=torch.float64)
    covered = 0
    for corners in uv:
        fragments = rasterise(corners, depth, torch.tensor([[0, 1, 2]]), 20, 20)
        seen = fragments.face >= 0
        covered += int(seen.sum())
        assert torch.isfinite(fragments.barycentric).all()
        assert ((fragments.depth >= 0.5) & (fragments.depth <= 1.5))[seen].all()
    assert covered > 100


def test_degenerate_triangles_and_empty_meshes_draw_nothing():
    line = torch.tensor([[0.0, 0], [5, 5], [10, 10], [3, 3]])
    none = rasterise(line, torch.ones(4), torch.tensor([[0, 1, 2], [3, 3, 3]]), 12, 12)
    assert (none.face == -1).all()
    empty = rasterise(line, torch.ones(4), torch.zeros(0, 3, dtype=torch.long), 3, 4)
    assert empty.face.shape == (3, 4)
    assert (empty.face == -1).all()
    assert rasterise(line[:0], torch.ones(0), torch.zeros(0, 3).long(), 1, 1).face.item() == -1


def test_the_first_of_equal_triangles_wins():
    uv = torch.tensor([[0.0, 0], [30, 0], [0, 30]])
    face = torch.tensor([[0, 1, 2]] * 3)
    assert (rasterise(uv, torch.ones(3), face, 5, 5).face == 0).all()


def test_bad_shapes_are_named():
    uv, depth, faces = torch.zeros(4, 2), torch.ones(4), torch.tensor([[0, 1, 2]])
    with pytest.raises(ShapeError, match="uv"):
        rasterise(torch.zeros(4, 3), depth, faces, 5, 5)
    with pytest.raises(ShapeError, match="depth"):
        rasterise(uv, torch.ones(3), faces, 5, 5)
    with pytest.raises(ShapeError, match="0 to 3, got 0 to 4"):
        rasterise(uv, depth, torch.tensor([[0, 1, 4]]), 5, 5)
    with pytest.raises(ShapeError, match="at least 1 x 1"):
        rasterise(uv, depth, faces, 0, 5)
    with pytest.raises(ShapeError, match="background"):
        render_meshes([], camera(5, 5, 5), background=torch.zeros(4, 5, 3))


def test_joined_faces_name_their_mesh():
    faces, owner = join_faces(
        [torch.tensor([[0, 1, 2]]), torch.tensor([[0, 2, 1], [1, 2, 3]])], [3, 4]
    )
    assert faces.tolist() == [[0, 1, 2], [3, 5, 4], [4, 5, 6]]
    assert owner.tolist() == [0, 1, 1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_vertex_normals_of_a_sphere_point_outward(dtype):
    vertices, faces = sphere(48, 24, dtype)
    lonely = torch.cat((vertices, vertices.new_zeros(1, 3)))
    normals = vertex_normals(lonely, faces)
    assert normals.dtype == dtype
    assert ((normals[:-1] * vertices).sum(-1) > 0.99).all()
    assert (normals[-1] == 0).all()


def test_shading_follows_lambert_and_blinn():
    light = Lighting(
        lamp_world=(0, 0, 2),
        target_world=(0, 0, 0),
        lamp=0.8,
        ambient=0.1,
        upward=0.0,
        specular=0.0,
    )
    point = torch.zeros(4, 3, dtype=torch.float64)
    tilt = torch.tensor([0.0, 0.5, 1.2, 2.5], dtype=torch.float64)
    normal = torch.stack((tilt.sin(), 0 * tilt, tilt.cos()), -1)
    albedo = torch.full((4, 3), 0.5, dtype=torch.float64)
    seen = light.shade(point, 7 * normal, albedo, EYE)
    expected = 0.5 * (0.1 + 0.8 * tilt.cos().clamp_min(0))
    torch.testing.assert_close(seen[:, 0], expected)
    # The eye is where the lamp is: the highlight is the full one for a surface that faces both.
    glow = replace(light, specular=0.3).shade(point, normal, albedo, EYE) - seen
    torch.testing.assert_close(glow[0, 0].item(), 0.8 * 0.3)
    assert (glow[:, 0].diff() <= 0).all()
    assert glow[3, 0] == 0
    # Off the axis of the cone it is darker; at the cone's angle by 1/e.
    off = torch.tensor([[2 * math.tan(0.3), 0.0, 0.0]]).double()
    towards = torch.tensor([[0.0, 0, 2]]).double() - off
    narrow = Lighting(lamp_world=(0, 0, 2), cone=0.3, lamp=1.0, ambient=0.0, specular=0.0)
    dim = narrow.shade(off, towards, torch.ones(1, 3).double(), EYE)
    assert abs(dim[0, 0].item() - math.exp(-1)) < 0.01


def test_zero_normals_stay_finite():
    points = torch.zeros(2, 3)
    points[1] = torch.tensor(Lighting().lamp_world)
    seen = Lighting().shade(points, torch.zeros(2, 3), torch.ones(2, 3), points[1])
    assert torch.isfinite(seen).all()


def ball(centre, radius, colour, **more):
    vertices, faces = sphere()
    place = torch.tensor(centre) + radius * vertices
    return Mesh(place, vertices, faces, torch.tensor(colour), **more)


def labels(meshes, camera):
    """The mesh that every pixel's centre sees, -1 where there is none."""
    faces, owner = join_faces([m.faces for m in meshes], [len(m.vertices_world) for m in meshes])
    uv, depth, valid = camera.project(torch.cat([m.vertices_world for m in meshes]))
    width, height = camera.image_size_wh
    face = rasterise(uv, depth, faces, height, width, valid=valid).face
    return torch.where(face >= 0, owner[face.clamp(min=0)], -1)


def test_a_rendered_frame_agrees_with_its_labels():
    height, width = 61, 83
    background = torch.full((height, width, 3), 40, dtype=torch.uint8)
    meshes = [ball([-0.4, 0, 0], 0.5, [0.9, 0.1, 0.1]), ball([0.2, 0, 0.6], 0.4, [0.1, 0.1, 0.9])]
    eye = camera(height, width, 90.0)
    image, seen = render_meshes(meshes, eye, background=background), labels(meshes, eye)
    mask = seen >= 0
    assert image.dtype == torch.uint8
    assert image.shape == (height, width, 3)
    assert set(seen.unique().tolist()) == {-1, 0, 1}
    # Red where part 0, blue where part 1, away from the antialiased borders.
    core = torch.nn.functional.max_pool2d
    for part, channel in ((0, 0), (1, 2)):
        inner = core((seen != part).float()[None], 3, 1, 1)[0] == 0
        colour = image[inner].float()
        assert inner.sum() > 300
        assert (colour[:, channel] > colour[:, 2 - channel]).all()
    # The background two pixels away is untouched, and the silhouette is mixed.
    away = core(mask.float()[None], 5, 1, 2)[0] == 0
    assert (image[away] == 40).all()
    alone = render_meshes(
        [m._replace(colour=torch.ones(3)) for m in meshes], eye, background=0 * background,
        shade=Lighting(lamp=0.0, ambient=1.0, upward=0.0).shade,
    )  # fmt: skip
    levels = alone[..., 0]
    assert (levels[core((~mask).float()[None], 3, 1, 1)[0] == 0] == 255).all()
    mixed = ((levels > 0) & (levels < 255)).sum()
    assert mixed > 50
    # Coverage and the mask measure the same area, to a tenth of a pixel per border pixel.
    assert abs(levels.float().sum() / 255 - mask.sum()) < 0.1 * mixed


def test_colour_per_vertex_and_texture(generator):
    height, width = 40, 40
    background = torch.zeros(height, width, 3, dtype=torch.uint8)
    eye = camera(height, width, 50.0)
    plain = ball([0, 0, 0], 1.0, [0.5, 0.5, 0.5])
    halves = torch.where(plain.vertices_world[:, :1] < 0, torch.eye(3)[0], torch.eye(3)[1])
    flat = Lighting(lamp=0.0, ambient=1.0, upward=0.0)

    def draw(mesh):
        return render_meshes([mesh], eye, background=background, shade=flat.shade)

    two = draw(plain._replace(colour=halves))
    assert two[20, 12, 0] > 200
    assert two[20, 12, 1] < 50
    assert two[20, 28, 1] > 200
    texture = random_texture(generator=generator, shortest=0.3, longest=0.6)
    cloth = draw(plain._replace(texture=texture, points_part=plain.vertices_world))
    assert draw(plain)[15:25, 15:25].float().std() < 1
    assert cloth[15:25, 15:25].float().std() > 5
    # The cloth moves with its part: the same coordinates elsewhere give the same factors.
    moved = plain._replace(texture=texture, points_part=plain.vertices_world + 0.3)
    assert not torch.equal(draw(moved), cloth)


def test_no_mesh_and_no_mesh_in_sight_show_the_background(generator):
    background = clutter_background(24, 31, generator=generator)
    eye = camera(24, 31, 30.0)
    for meshes in ([], [ball([0, 0, 10.0], 1.0, [1, 1, 1])], [ball([50.0, 0, 0], 1.0, [1, 1, 1])]):
        assert torch.equal(render_meshes(meshes, eye, background=background), background)


def test_texture_has_the_contrast_that_was_asked_for(generator):
    points = torch.rand(20000, 3, generator=generator, dtype=torch.float64)
    factor = random_texture(generator=generator, contrast=0.1)(points)
    assert factor.shape == (20000, 1)
    assert abs(factor.mean() - 1) < 0.02
    assert abs(factor.std() - 0.1) < 0.01


@pytest.mark.parametrize(("height", "width"), [(60, 80), (61, 33), (8, 8)])
def test_the_room_is_reproducible_cluttered_and_unevenly_lit(height, width):
    def room(seed):
        return clutter_background(height, width, generator=torch.Generator().manual_seed(seed))

    picture = room(3)
    assert picture.dtype == torch.uint8
    assert picture.shape == (height, width, 3)
    assert torch.equal(picture, room(3))
    assert not torch.equal(picture, room(4))
    if width == 80:
        grey = picture.float().mean(-1)
        assert (grey.diff(dim=1).abs() > 20).float().mean() > 0.03  # hard edges
        blocks = torch.nn.functional.avg_pool2d(grey[None], 20)[0]
        assert blocks.max() > 1.5 * blocks.min()  # light and dark corners


def test_value_noise_is_smooth_and_of_unit_size(generator):
    noise = value_noise(200, 200, cell=10, octaves=1, generator=generator)
    # About 400 independent cells: four standard errors of a standard deviation; bicubic
    # interpolation between cells averages some of it away.
    assert 0.5 < noise.std() < 1.2
    assert noise.diff(dim=0).abs().max() < 0.8


def test_sensor_noise_has_the_stated_variance(generator):
    grey = torch.full((200, 200, 3), 100, dtype=torch.uint8)
    noisy = add_sensor_noise(grey, generator=generator)
    error = noisy.double() - 100
    variance = READ**2 + SHOT * 100 + 1 / 12  # rounding adds a twelfth
    count = error.numel()
    assert error.mean().abs() < 4 * math.sqrt(variance / count)
    assert abs(error.var() - variance) < 4 * variance * math.sqrt(2 / count)
