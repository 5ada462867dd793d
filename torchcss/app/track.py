"""From files to files: a video in, a first pose found, the track written.

`track_video` is what `torchcss track` calls, `resume` what it calls with `--resume`. The loop
itself is `TrackingSession`, which takes any images; `torchcss.app.recorder.Recorder` writes what
comes out as it goes.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from torchcss.app.claims import WorkClaim
from torchcss.app.detect import DetectOptions, detect_video, is_detected
from torchcss.app.init import initialise_video
from torchcss.app.lens import PERSONS, KnownLens, fitted
from torchcss.app.lock import locked
from torchcss.app.recorder import CHECKPOINT_EVERY, OF_A_TRACK, Recorder, Sink
from torchcss.app.view_files import FrameSelection, OpenView, moments, open_run, open_view
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.errors import (
    CameraError,
    ConfigurationError,
    KeypointError,
    OutputError,
    TrackFileError,
    check_positive,
    check_range,
)
from torchcss.files import StrPath, load_arrays, make_paths, naming, prepare_output_folder
from torchcss.initialise.noise import Noise
from torchcss.initialise.options import LEAST_JOINTS
from torchcss.initialise.result import Initialisation, check_stature, stature_of
from torchcss.io.cameras import LoadedCamera, load_camera
from torchcss.io.fitted_body import FITTED_BODY_NAME, read_fitted_body, write_fitted_body
from torchcss.io.keypoints.links import Links
from torchcss.io.keypoints.masks import masks_of
from torchcss.io.keypoints.read import Scale
from torchcss.io.run import Run, as_run
from torchcss.io.tracks import TRACK_NAME
from torchcss.io.video import VideoReader
from torchcss.io.view_files import ViewFiles, fingerprint
from torchcss.joint_names import JOINT_NAMES
from torchcss.show.track_pictures import write_overlays
from torchcss.tracking.checkpoint import state_from_tensors
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import Settings, settings_from_plain
from torchcss.types import frozen
from torchcss.vision.camera import Camera


@frozen
class TrackOptions:
    """What else there is to say about the files of a run, beside its settings.

    Attributes:
        stride: Every how many frames to track.
        camera_name: Which camera of the file; by default the one of this video.
        layout: Layout of a keypoint file that does not name its joints, e.g. BODY_25; own: take
            its names as they are.
        normalised: Whether keypoints are pixels, or fractions of the image from 0 to 1 or from -1
            to 1.
        masks: Foreground of every frame, white or in shades of belief: a video or a folder of
            images of the video's size.
        init: A fitted body that `torchcss init` wrote for the first frame, to start from.
        first: The same as `initialise` returns it.
        others: What further synchronised cameras of the same calibration recorded. Their videos may
            be of another size; one that ends, or shows a single colour for a while, is left out as
            long. Their overlays are `overlay_2.mp4` and so on.
        live: What wants to see the frames while they are tracked, such as a
            `torchcss.app.live.LiveViewer`; closed at the end.
        resume: Go on with what an interrupted run of the same settings left in the folder; start
            where there is nothing.
        checkpoint_every: Seconds of wall time between checkpoints.
        claim: What has to hold before each checkpoint, so that nobody else writes into the folder;
            by default its lock (`torchcss.app.lock`).
        frame_rate: Frames per second of a folder of images; None: 30.
        person: Who of several people is followed: prominent, largest, leftmost or centre in the
            first frame, or the keypoint file's number of a person.
        sigma: Noise of a wrist's keypoint, or of a robot's joint, pixels; None: learnt from the
            first frame's.
        focal: Focal length in pixels, of a camera that nobody calibrated.
        fov: The same as angle between the left and the right border of the image, degrees.
        detect: What finds the keypoints where no file of them is given.
    """

    stride: int = 1
    camera_name: str | None = None
    layout: str | None = None
    normalised: Scale = "pixels"
    masks: Path | None = None
    init: Path | None = None
    first: Initialisation | None = None
    others: Sequence[ViewFiles] = ()
    live: Sink | None = None
    resume: bool = False
    checkpoint_every: float = CHECKPOINT_EVERY
    claim: WorkClaim | None = None
    frame_rate: float | None = None
    person: str = "prominent"
    sigma: float | None = None
    focal: float | None = None
    fov: float | None = None
    detect: DetectOptions = DetectOptions()

    def __post_init__(self) -> None:
        make_paths(self)
        check_positive(self, "sigma", finite=True)
        check_range(self, "checkpoint_every", hint=" seconds", finite=False)


def track_video(
    video: StrPath,
    *,
    camera: StrPath | None = None,
    keypoints: StrPath | None = None,
    out: StrPath,
    settings: Settings | None = None,
    start: int = 0,
    stop: int | None = None,
    options: TrackOptions | None = None,
) -> Run:
    """Track a body through a video file.

    Args:
        video: A video, or a folder of images.
        camera: Calibration file, see `torchcss.io.cameras`; None: see `torchcss.app.lens`.
        keypoints: 2D joints, see `torchcss.io.keypoints`; None: they are detected, and written into
            the folder.
        out: Folder for `track.npz`, `summary.json`, `checkpoint.npz`, `overlay.mp4`,
            `report.html`, and the body at its first pose, `body.npz`.
        settings: How to track.
        start: First frame.
        stop: Frame before which to end.
        options: What else there is to say about the files.

    Returns:
        The run; its `summary` says what was run and what it cost.

    Raises:
        TorchcssError: With one line that says what was wrong, for any bad input, and where another
            process writes into the folder.
    """
    settings, options = settings or Settings(), options or TrackOptions()
    out = prepare_output_folder(Path(out))
    selection = FrameSelection(start=start, stop=stop, stride=options.stride)
    with locked(out) if options.claim is None else nullcontext(options.claim) as lock:
        if options.resume and (out / TRACK_NAME).is_file():
            begun = Run.open(out)
            if begun.checkpoint is not None:
                begun = _with_files(begun, Path(video), camera, keypoints, options)
                return _go_on(begun, settings, _moved_again(begun, selection), options, lock)
        # What is wrong is told before the detector runs, which may take long.
        body = load_body(settings.body) if options.first is None else options.first.body
        check_stature(settings.body, settings.stature)
        if keypoints is None:
            _check_for_detector(body)
        source, is_known = _camera_of(Path(video), camera, options, start)
        files = _files_of(Path(video), keypoints, options)
        if keypoints is None:
            files = _with_keypoints(files, source, out, selection, options)
            if options.init is None and options.first is None:
                selection = _from_somebody(out / _KEYPOINTS_NAME, selection, options.person)
        views = _all_views(files, source, selection, options, body.joint_of_name)
        if selection.start != start:
            views[0] = views[0].noted(
                f"nobody is seen in frame {start}: tracked from frame {selection.start} on"
            )
        if not is_known:
            _now("fitting the focal length to the keypoints")
            views = [fitted(views[0], settings)]
        return _begin(views, out, settings, selection, options, lock)


def _begin(
    views: Sequence[OpenView],
    out: Path,
    settings: Settings,
    selection: FrameSelection,
    options: TrackOptions,
    lock: WorkClaim,
) -> Run:
    """Find the first pose, and track from it."""
    _check_not_replaced(views, out)
    start = selection.start
    generator = torch.Generator().manual_seed(settings.seed)
    eye = views[0].camera.camera.to(dtype=settings.torch_dtype, device=settings.device)
    _now(f"finding the first pose, in frame {start}")
    first = _first_pose(views, eye, settings, start, options, generator)
    views = [opened.with_noise(first.noise) for opened in views]
    names = [f"{view.camera.camera.name}: " if len(views) > 1 else "" for view in views]
    seen = zip(names, views, strict=True)
    notes = [*(name + note for name, view in seen for note in view.notes), *first.report]
    tqdm.write("\n".join(notes))
    interval = views[0].reader.usual_interval
    looking = [opened.view(first.body.tie) for opened in views]
    session = TrackingSession(
        settings, first, looking, frame_interval=interval, generator=generator
    )
    body = out / FITTED_BODY_NAME
    given = options.init and options.init.resolve()
    is_given = given in (out.resolve(), body.resolve())  # what was started from stays as it is
    recorder = Recorder(
        folder=out,
        session=session,
        recorded=[opened.recorded for opened in views],
        frame_interval=interval,
        size_deviation=_size_deviation(settings, first, len(views)),
        notes=notes,
        extra=_description(views, first, selection, options.init),
        sink=options.live,
        on_first_frame=None if is_given else partial(write_fitted_body, body, first, eye),
        checkpoint_every=options.checkpoint_every,
        lock=lock,
    )
    return _record(recorder, views)


def _check_not_replaced(views: Sequence[OpenView], out: Path) -> None:
    """Refuse a folder in which a file that is read has the name of one that is made of a track."""
    for files in (view.files for view in views):
        for path in filter(None, (files.video, files.keypoints, files.masks)):
            if OF_A_TRACK.fullmatch(path.name) and path.parent.resolve() == out.resolve():
                raise OutputError(
                    f"{path}: a run in this folder replaces it; choose another one with --out"
                )


def _size_deviation(settings: Settings, first: Initialisation, num_cameras: int) -> float:
    """What is not known of the body's size: of a person of any stature before one camera."""
    known = num_cameras > 1 or settings.body not in PERSONS or settings.stature is not None
    return 0.0 if known else first.size_deviation


_KEYPOINTS_NAME = "keypoints.npz"
"""Where keypoints that are detected lie in the folder of a run."""


def _files_of(video: Path, keypoints: StrPath | None, options: TrackOptions) -> ViewFiles:
    """The first camera's files, as they are given."""
    return ViewFiles(
        video=video,
        keypoints=None if keypoints is None else Path(keypoints),
        camera_name=options.camera_name,
        masks=options.masks,
        layout=options.layout,
        normalised=options.normalised,
        frame_rate=options.frame_rate,
        person=options.person,
        sigma=options.sigma,
    )


def _with_keypoints(
    files: ViewFiles,
    source: Path | LoadedCamera,
    out: Path,
    selection: FrameSelection,
    options: TrackOptions,
) -> ViewFiles:
    """The files with keypoints that are detected, and their masks where none are given."""
    open_view(files, source, selection)
    keypoints = out / _KEYPOINTS_NAME
    detect_video(
        files.video, keypoints, options.detect, frame_rate=files.frame_rate,
        start=selection.start, stop=selection.stop,
    )  # fmt: skip
    masks = files.masks
    if masks is None and masks_of(keypoints).is_file():
        masks = masks_of(keypoints)
    return replace(files, keypoints=keypoints, masks=masks)


_WELL_SEEN = 0.7
"""Share of the usual confidence with which somebody is seen well enough to start from."""


def _from_somebody(keypoints: Path, selection: FrameSelection, person: str) -> FrameSelection:
    """The frames from the first one on that shows a person well, where the first shows nobody.

    The person is the one who is asked for by number, or who is seen most in all: a detector sees
    somebody who is not there for a few frames.

    Args:
        keypoints: What was detected.
        selection: The frames that are asked for.
        person: Who is asked for.
    """
    arrays = load_arrays(keypoints, KeypointError)
    belief = _seen(arrays)[selection.start : selection.stop]
    if belief[0].any():
        return selection
    numbers = arrays["person_ids"].astype(str).tolist()
    most = numbers.index(person) if person in numbers else int(belief.sum(0).argmax())
    own = belief[:, most]
    if not own.any():
        return selection
    later = np.flatnonzero(own >= _WELL_SEEN * np.median(own[own > 0.0]))
    return replace(selection, start=selection.start + int(later[0]))


def _moved_again(begun: Run, selection: FrameSelection) -> FrameSelection:
    """The frames with the start of a run that began later, where somebody was seen."""
    assert begun.checkpoint is not None
    known = begun.checkpoint.notes["extra"]["frames_selected"]["start"]
    keypoints = _detected_by(begun)
    if keypoints is None or known <= selection.start:
        return selection
    nobody = not _seen(load_arrays(keypoints, KeypointError))[selection.start].any()
    return replace(selection, start=known) if nobody else selection


def _seen(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """How much is seen of everybody in every frame: the confidences of joints in the picture."""
    places = arrays["keypoints"]
    inside = ((places > -0.5) & (places < arrays["image_size_wh"] - 0.5)).all(-1)
    return np.where(inside, arrays["confidence"], 0.0).sum(-1)


def _detected_by(run: Run) -> Path | None:
    """The keypoints that a run detected itself; None: they were given."""
    own = run.cameras[0].files
    if own is None or own.keypoints is None:
        return None
    found = (run.folder / _KEYPOINTS_NAME).resolve()
    return own.keypoints if own.keypoints.resolve() == found else None


def _check_for_detector(body: BodyModel) -> None:
    """Refuse to look for people where the body is none."""
    if len(set(body.joint_names) & set(JOINT_NAMES)) < LEAST_JOINTS:
        raise ConfigurationError(
            f"{body.name} has no joints of a person, which is what detectors find: give "
            "keypoints, of the first frame at least (torchcss init --click, or a labelling tool), "
            f"named as its own: {', '.join(body.joint_names)}"
        )


def _detect_further(run: Run, selection: FrameSelection, options: TrackOptions) -> None:
    """Find the keypoints anew where a run goes on beyond the frames that were looked at."""
    own, keypoints = run.cameras[0].files, _detected_by(run)
    if own is not None and keypoints is not None and not is_detected(keypoints, selection.stop):
        detect_video(
            own.video, keypoints, options.detect, frame_rate=own.frame_rate,
            start=selection.start, stop=selection.stop,
        )  # fmt: skip


def _camera_of(
    video: Path, camera: StrPath | None, options: TrackOptions, start: int
) -> tuple[Path | LoadedCamera, bool]:
    """The calibration file or the camera, and whether its focal length is known."""
    lens = KnownLens(focal=options.focal, fov=options.fov)
    if camera is not None:
        return lens.unless(Path(camera)), True
    # Pictures before the first one to be tracked may be of another size.
    lens, info = lens.of(video), VideoReader(video, start=max(start, 0)).info
    return lens.camera(info.width, info.height), lens.is_known


def _all_views(
    own: ViewFiles,
    source: Path | LoadedCamera,
    selection: FrameSelection,
    options: TrackOptions,
    links: Links,
) -> list[OpenView]:
    """The files of all cameras opened."""
    views = [open_view(each, source, selection, links) for each in (own, *options.others)]
    for opened in views:
        if len(views) > 1 and not opened.camera.metric:
            raise CameraError(
                f"{opened.files.video}: several cameras need their places in one world, in "
                f"metres: {opened.camera.units_note or 'give R and t'}"
            )
    return views


def _now(what: str) -> None:
    """Say what is being done, which may take a while."""
    tqdm.write(f"{what} ...", file=sys.stderr)


def resume(run: Run | StrPath, *, live: Sink | None = None) -> Run:
    """Go on with an interrupted run, as if it had never been interrupted.

    Args:
        run: The run, or its folder.
        live: What wants to see the frames while they are tracked.

    Returns:
        The run as it is then; a complete one is left as it is.

    Raises:
        TorchcssError: If it left no checkpoint, its files are gone, or another process goes on
            with it.
    """
    run = as_run(run)
    if run.checkpoint is None:
        raise TrackFileError(
            f"{run.folder}: no checkpoint to go on from; track again, without --resume"
        )
    known = run.checkpoint.notes["extra"]["frames_selected"]
    settings = settings_from_plain(run.settings)
    with locked(run.folder) as lock:
        return _go_on(run, settings, FrameSelection(**known), TrackOptions(live=live), lock)


def _go_on(
    run: Run, settings: Settings, selection: FrameSelection, options: TrackOptions, lock: WorkClaim
) -> Run:
    """Track the frames that a run has not got to."""
    checkpoint, out = run.checkpoint, run.folder
    assert checkpoint is not None
    _check_same(run, settings, selection, checkpoint.notes["extra"]["frames_selected"])
    _detect_further(run, selection, options)
    views = open_run(run, selection)
    body = run.body.to(dtype=settings.torch_dtype, device=settings.device)
    state = state_from_tensors(checkpoint.tensors, body)
    interval = views[0].reader.usual_interval
    session = TrackingSession.resume(
        state, settings, [opened.view(body.tie) for opened in views], frame_interval=interval
    )
    recorder = Recorder(
        folder=out,
        session=session,
        recorded=run.cameras,
        frame_interval=interval,
        sink=options.live,
        extra=_files_seen(views),
        checkpoint_every=options.checkpoint_every,
        begun=run,
        lock=lock,
    )
    return _record(recorder, views)


def _record(recorder: Recorder, views: Sequence[OpenView]) -> Run:
    """Track the frames that are left, and make what is made when all are tracked."""
    left = islice(moments(views), recorder.num_done, None)
    recorder.run(recorder.session.track(left), views[0].reader.num_selected)
    run = Run.open(recorder.folder)
    if recorder.session.settings.overlay:
        # Drawing figures takes long to import.
        from torchcss.show.report import write_report_page

        _now("drawing overlay and report")
        write_overlays(run, views[0].reader.selected_rate)
        write_report_page(run)
    return run


def _check_same(
    run: Run, settings: Settings, selection: FrameSelection, known: dict[str, Any]
) -> None:
    """Refuse to go on with other settings or frames than a run was begun with."""
    before = {**asdict(settings_from_plain(run.settings)), **known}
    now = {**asdict(settings), **asdict(selection)}
    told = {name: now[name] for name in now if name not in ("overlay", "threads", "stop")}
    with naming(run.folder, ConfigurationError):
        _refuse_others(before, told)


def _refuse_others(before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to go on with other choices than a run was begun with."""
    if other := [f"{n} {before[n]}, now {value}" for n, value in now.items() if value != before[n]]:
        raise ConfigurationError(
            f"the run was begun with {'; '.join(other)}; give the same, or leave --resume out to "
            "start anew"
        )


def _with_files(
    run: Run, video: Path, camera: StrPath | None, keypoints: StrPath | None, options: TrackOptions
) -> Run:
    """The run with its files where they are now; others than it was begun with are refused."""
    assert run.checkpoint is not None
    told = run.checkpoint.notes["extra"]
    known = told.get("fingerprints", ())
    own = _files_of(video, keypoints, options)
    cameras = list(run.cameras)
    with naming(run.folder, ConfigurationError):
        if options.init is not None and "first_pose" in told:
            _check_first_pose(told["first_pose"], options.init)
        if len(options.others) >= len(cameras):
            raise ConfigurationError(f"the run was begun with {len(cameras)} cameras, not more")
        for place, given in enumerate((own, *options.others)):
            recorded = cameras[place]
            _check_camera(recorded.camera, given, camera, options)
            if recorded.files is not None:
                _check_same_options(recorded.files, given)
                prints = known[place] if place < len(known) else {}
                cameras[place] = recorded._replace(files=recorded.files.moved(given, prints))
    return replace(run, track=run.track._replace(cameras=tuple(cameras)))


_OF_VIEWS = ("layout", "normalised", "offset", "frame_rate", "person", "sigma")
"""What else is said of a camera's files, once and for all."""


def _check_same_options(files: ViewFiles, given: ViewFiles) -> None:
    """Refuse to read the files of a run otherwise than it was begun with, where that is said."""
    usual = ViewFiles(video=given.video, keypoints=None)
    before, now, default = asdict(files), asdict(given), asdict(usual)
    names = [*_OF_VIEWS, *(name for name in ("keypoints", "masks") if before[name] is None)]
    _refuse_others(before, {name: now[name] for name in names if now[name] != default[name]})


def _check_first_pose(known: Mapping[str, str] | None, given: Path) -> None:
    """Refuse another first pose than a run was begun with."""
    if known is None or known["fingerprint"] != _print_of_pose(given):
        begun = "without --init" if known is None else f"with --init {known['file']}"
        raise ConfigurationError(
            f"the run was begun {begun}, now {given} is another first pose; give the same, or "
            "leave --resume out to start anew"
        )


def _print_of_pose(path: Path) -> str:
    """What tells a fitted body from others, given as its file or as the folder that holds it."""
    return fingerprint(path / FITTED_BODY_NAME if path.is_dir() else path)


def _check_camera(
    known: Camera, given: ViewFiles, calibration: StrPath | None, options: TrackOptions
) -> None:
    """Refuse another camera than a run was begun with."""
    lens = KnownLens(focal=options.focal, fov=options.fov)
    if calibration is not None:
        path = lens.unless(Path(calibration))
        camera = load_camera(path, given.camera_name, video=given.video).camera
    elif lens.is_known:
        camera = lens.camera(*known.image_size_wh).camera
    else:
        return
    pairs = zip(camera.buffers(), known.buffers(), strict=True)
    if camera.image_size_wh != known.image_size_wh or not all(
        torch.allclose(one, other) for one, other in pairs
    ):
        raise ConfigurationError(
            f"the run was begun with the camera {known.name!r} as it was then, now {camera.name!r} "
            "has other numbers; give the same, or leave --resume out to start anew"
        )


def _first_pose(
    views: Sequence[OpenView],
    eye: Camera,
    settings: Settings,
    start: int,
    options: TrackOptions,
    generator: torch.Generator,
) -> Initialisation:
    """What is known of the first frame, or the body fitted to its keypoints and image."""
    if options.first is not None:
        return options.first
    if options.init is not None:
        return first_pose_from_file(options.init, eye, settings)
    view, *beside = views
    if view.keypoints is None:
        raise ConfigurationError(
            f"{view.files.video}: the first camera needs keypoints, from which the first pose is "
            "found"
        )
    return initialise_video(
        view.files.video,
        view.keypoints,
        eye,
        settings,
        start=start,
        noise=Noise(view.sigma, is_guess=view.files.sigma is None),
        generator=generator,
        others=[each.view(eye.K).at(start) for each in beside],
    )


def first_pose_from_file(path: Path, camera: Camera, settings: Settings) -> Initialisation:
    """A fitted body, hung before the video's camera as it was before the picture's.

    Args:
        path: Its file, or the folder that holds it.
        camera: The video's camera.
        settings: How it is to be tracked.

    Raises:
        ConfigurationError: If the settings are of another body or stature, or would fit another.
    """
    fitted = read_fitted_body(
        path, camera=camera, dtype=settings.torch_dtype, device=settings.device
    )
    # A body from a file is named by its path, which can be written in several ways.
    if Path(fitted.body.name).resolve() != Path(settings.body).resolve():
        raise ConfigurationError(
            f"{path}: the fitted body is {fitted.body.name}, to be tracked is {settings.body}; "
            f"give the body {fitted.body.name}"
        )
    tall, told = stature_of(fitted.lengths, fitted.scale), settings.stature
    if told is not None and abs(tall / told - 1) > _SAME_STATURE:
        raise ConfigurationError(
            f"{path}: the fitted body is {tall:.2f} m tall, the stature is said to be {told:g} m: "
            "leave it out, or give it where the body is fitted (torchcss init --stature)"
        )
    if settings.ground is not None:
        raise ConfigurationError(
            f"{path}: the fitted body has a size, which the ground would tell: leave it out, or "
            "give it where the body is fitted (torchcss init --ground)"
        )
    if settings.free_root and not has_root(fitted.body):
        raise ConfigurationError(
            f"{path}: the fitted body stands in one place: leave free_root out, or give it where "
            "the body is fitted (torchcss init --free-root)"
        )
    return fitted


_SAME_STATURE = 0.02
"""Relative: fitted lengths miss a known stature by so much, where they end at their limits."""


def _description(
    views: Sequence[OpenView], first: Initialisation, selection: FrameSelection, init: Path | None
) -> dict[str, Any]:
    """Entries of the summary about the files."""
    return {
        **_files_seen(views),
        "world_is_metric": views[0].camera.metric,
        "body_lengths_m": dict(first.body.lengths),
        "frames_selected": asdict(selection),
        "fingerprints": [opened.files.fingerprints() for opened in views],
        "first_pose": init and {"file": str(init), "fingerprint": _print_of_pose(init)},
    }


def _files_seen(views: Sequence[OpenView]) -> dict[str, Any]:
    """Entries of the summary about where the files are."""
    seen, *others = (
        {"video": str(opened.files.video), "camera": opened.camera.camera.name} for opened in views
    )
    return {**seen, "other_views": others}
