"""A fitted body and its first hypotheses on disk: what `torchcss init` writes and `track` takes.

One NPZ file, schema version 1. K hypotheses, n parameters, P parts, L lengths:

| array | shape | meaning |
|---|---|---|
| `schema_version` | | 1 |
| `body` | | name of the body; of one from a file, its path as it was given |
| `body_file` | | the absolute path of that file; empty for a body that ships |
| `scale` | | of the standard humanoid |
| `size_deviation` | | what is not known of the person's size: deviation of its logarithm |
| `length_names`, `lengths` | L | fitted lengths, metres |
| `part_names`, `part_shape` | P, P 9 | shape numbers of the parts |
| `state_names` | n | names of the parameters |
| `lower`, `upper` | n, n | limits of the parameters, infinite where there are none |
| `sticky_mean`, `sticky_deviation` | n, n | the prior that draws them to rest; infinite: none |
| `motion_rate` | n | expected velocities, radians or metres per second |
| `neighbours` | N 2 | names of the parts that touch in every pose |
| `state`, `covariance`, `log_weight`, `cost` | K n, K n n, K, K | the hypotheses, best first |
| `uncapped` | n n | covariance of the best that no prior caps; may be missing |
| `uncapped_floored` | | whether it needed a least curvature; may be missing |
| `base_rotation`, `base_translation` | 3 3, 3 | frame in which the root moves, in the world |
| `camera_rotation`, `camera_translation`, `camera_matrix` | 3 3, 3, 3 3 | the picture's camera |

Files without limits, prior and neighbours have those that the body is built with.

`write_fitted_body` and `read_fitted_body`. The latter can hang the body before another camera of
the same place, such as the calibrated one of a video whose first frame was fitted without.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from torchcss.body.load import BODY_SUFFIXES, load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES
from torchcss.body.shape import with_shape
from torchcss.errors import BodyError
from torchcss.files import StrPath, load_arrays, naming, save_arrays
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.result import Initialisation
from torchcss.io.track_body import PARAMETER_NUMBERS, set_numbers
from torchcss.types import as_array
from torchcss.vision.camera import Camera

BODY_VERSION = 1
FITTED_BODY_NAME = "body.npz"


def write_fitted_body(path: StrPath, found: Initialisation, camera: Camera) -> None:
    """Write the result of an initialisation.

    Args:
        path: The NPZ file.
        found: What was fitted.
        camera: The camera of the picture.

    Raises:
        OutputError: If it cannot be written.
    """
    body, mixture = found.body, found.mixture
    tensors = {
        "part_shape": body.part_shape,
        **{name: getattr(body, name) for name in PARAMETER_NUMBERS},
        "state": mixture.mean,
        "covariance": mixture.covariance,
        "log_weight": mixture.log_weight,
        "cost": found.cost,
        **({} if found.uncapped is None else {"uncapped": found.uncapped}),
        "base_rotation": body.base_rotation,
        "base_translation": body.base_translation,
        "camera_rotation": camera.R_camera_world,
        "camera_translation": camera.t_camera_world,
        "camera_matrix": camera.K,
    }
    about = {
        "schema_version": BODY_VERSION,
        "body": body.name,
        "body_file": os.path.abspath(body.name) if _is_file(body.name) else "",
        "scale": found.scale,
        "noise": found.noise,
        "size_deviation": found.size_deviation,
        "uncapped_floored": found.uncapped_floored,
        "length_names": np.array(list(found.lengths), dtype=np.str_),
        "lengths": np.array(list(found.lengths.values()), dtype=np.float64),
        "part_names": np.array(body.part_names, dtype=np.str_),
        "state_names": np.array(body.state_names, dtype=np.str_),
        "neighbours": np.array(body.neighbours, dtype=np.str_).reshape(-1, 2),
    }
    arrays = {name: as_array(tensor) for name, tensor in tensors.items()}
    save_arrays(Path(path), {**about, **arrays})


def read_fitted_body(
    path: StrPath,
    *,
    camera: Camera | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Initialisation:
    """Read a fitted body back.

    Args:
        path: The NPZ file, or the folder that `torchcss init` wrote.
        camera: The camera that will look at it, at the place of the picture's: the body keeps its
            place before the camera. None: it keeps its place in the world.
        dtype: Type of the body.
        device: Where to put it.

    Raises:
        BodyError: If the file is missing, damaged, or of another version or body.
    """
    path = Path(path)
    if path.is_dir():
        path = path / FITTED_BODY_NAME
    arrays = load_arrays(path, BodyError)
    try:
        names, values = arrays["length_names"].tolist(), arrays["lengths"].tolist()
        if int(arrays["schema_version"]) != BODY_VERSION:
            raise BodyError(
                f"{path}: schema version {int(arrays['schema_version'])}, expected "
                f"{BODY_VERSION}; write the file with this version of torchcss init"
            )
        lengths, scale = dict(zip(names, values, strict=True)), float(arrays["scale"])
        body = _load_body(path, arrays, {name: lengths[name] / scale for name in names}, scale)
        tensors = {
            name: tensor.to(dtype=dtype, device=device)
            for name, tensor in _read_tensors(path, arrays, body).items()
        }
    except KeyError as error:
        raise BodyError(
            f"{path}: not a fitted body: {error.args[0]} is missing; expected a body.npz, as "
            "torchcss init and torchcss track write it"
        ) from error
    except BodyError:
        raise
    except (ValueError, TypeError) as error:
        raise BodyError(f"{path}: not a fitted body: {error}") from error
    rotation, translation = tensors["base_rotation"], tensors["base_translation"]
    if camera is not None:
        to, at = tensors["camera_rotation"], tensors["camera_translation"]
        back = camera.R_camera_world.to(to).T
        rotation = back @ to @ rotation
        translation = back @ (to @ translation + at - camera.t_camera_world.to(to))
    body = with_shape(body.to(dtype=dtype, device=device), tensors["part_shape"])
    mixture = GaussianMixture(tensors["state"], tensors["covariance"], tensors["log_weight"])
    note = f"first pose: {len(mixture.mean)} hypotheses from {path}"
    body = body.with_base(rotation, translation)
    found = Initialisation(body, mixture, tensors["cost"], (note,), lengths, scale)
    # Earlier files lack these.
    return found._replace(
        uncapped=tensors.get("uncapped"),
        uncapped_floored=bool(arrays.get("uncapped_floored", found.uncapped_floored)),
        noise=float(arrays.get("noise", found.noise)),
        size_deviation=float(arrays.get("size_deviation", found.size_deviation)),
    )


def _load_body(
    path: Path, arrays: Mapping[str, np.ndarray], lengths: Mapping[str, float], scale: float
) -> BodyModel:
    """The body of the file's name, without its fitted shape."""
    name = str(arrays["body"])
    # A robot that stands fixed may have been fitted with a root.
    rooted = set(ROOT_NAMES) <= set(arrays["state_names"].tolist())
    if _is_file(name):
        name = _file_of_body(name, str(arrays.get("body_file", "")), path)
    body = load_body(name, lengths=lengths, scale=scale, free_root=rooted)
    for key, expected in (("state_names", body.state_names), ("part_names", body.part_names)):
        if tuple(arrays[key].tolist()) != expected:
            raise BodyError(f"{path}: {key} are not those of {name}; fit the body again")
    if "neighbours" in arrays:
        pairs = arrays["neighbours"].reshape(-1, 2).tolist()
        if not {part for pair in pairs for part in pair} <= set(body.part_names):
            raise BodyError(f"{path}: neighbours: expected names of parts of {name}")
        body.neighbours = tuple((first, second) for first, second in pairs)
    numbers = {
        key: torch.from_numpy(np.array(arrays[key], dtype=np.float64))
        for key in PARAMETER_NUMBERS
        if key in arrays
    }
    with naming(path, BodyError):
        set_numbers(body, numbers)
    return body


def _read_tensors(
    path: Path, arrays: Mapping[str, np.ndarray], body: BodyModel
) -> dict[str, torch.Tensor]:
    """The numbers of a file, finite and of the shapes that they must have."""
    k, n = len(arrays["state"]), body.num_parameters
    shapes = {
        "part_shape": (body.num_parts, 9), "state": (k, n), "covariance": (k, n, n),
        "log_weight": (k,), "cost": (k,), "base_rotation": (3, 3), "base_translation": (3,),
        "camera_rotation": (3, 3), "camera_translation": (3,),
    }  # fmt: skip
    if "uncapped" in arrays:
        shapes["uncapped"] = (n, n)
    tensors = {}
    for key, shape in shapes.items():
        tensors[key] = torch.from_numpy(np.array(arrays[key], dtype=np.float64))
        if tensors[key].shape != shape or not bool(tensors[key].isfinite().all()):
            raise BodyError(
                f"{path}: {key}: expected finite numbers of shape {list(shape)}, "
                f"got {list(tensors[key].shape)}"
            )
    return tensors


def _is_file(name: str) -> bool:
    """Whether a body of this name is one from a file."""
    return Path(name).suffix.lower() in BODY_SUFFIXES


def _file_of_body(given: str, absolute: str, fitted: Path) -> str:
    """Where the file of a body is now, be it that folders moved or that this is another machine.

    Args:
        given: Its path as it was given, perhaps from another folder than this.
        absolute: Its absolute path then; empty if it is not known.
        fitted: The file of the fitted body, beside which it may have been put.

    Raises:
        BodyError: If it is at none of the places.
    """
    folder = fitted.parent
    places = (absolute, given, str(folder / given), str(folder / Path(given).name))
    tried = [place for place in dict.fromkeys(places) if place]
    # Unlike `Path.is_file`, this also answers for what cannot be a path.
    for place in tried:
        if os.path.isfile(place):
            return place
    raise BodyError(
        f"{fitted}: the file of its body is missing; tried {', '.join(tried)}; put it beside "
        f"{fitted.name}"
    )
