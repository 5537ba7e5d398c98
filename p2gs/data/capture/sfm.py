"""Structure from motion with pycolmap, in a process of its own: ``python -m p2gs.data.capture.sfm JOB.json``.

The only file that imports pycolmap. It runs as a child because COLMAP aborts the interpreter where others raise (a
wheel asked for ONNX features, for one). What it has to do stands in the job file; what it found goes to ``out``; its
progress goes to stdout, one line each. Incremental mapping and SIFT only: global mapping misplaced photographs of small
captures, and the wheel has no other features.
"""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

VOTERS = 400  # features of largest scale that vote on which photographs may show the same thing
MIN_VOTES = 4  # mutual best among them; by chance two photographs of different places have 0 to 2
# threads of adjustments: several add up in another order each time, and half a millimetre of a plain room hung on that
ADJUSTING = 1
PARTNERS = 20  # photographs that each is matched with; a hand-held walk has about 6 neighbours at each of three heights


@dataclass(frozen=True)
class Effort:
    """How hard features and registration try. ``max_size``: long edge in pixels that features are found at."""

    max_size: int = 1200
    first_octave: int = 0
    features: int = 3000
    # contrast below which a feature is noise; COLMAP's own is 0.0067, fewer features on plain walls
    peak: float = 0.004
    init_inliers: int = 60
    init_angle: float = 8.0  # degrees
    pose_inliers: int = 20
    preselect: bool = True  # only pairs that votes of large features suggest


FAST = Effort()
# measured: from 2 of 24 photographs of a plain room to 23 and 24
CAREFUL = Effort(1600, -1, 8192, 0.002, 40, 4.0, 15, False)


def say(text: str) -> None:
    print(text, flush=True)


def reconstruct(job: dict) -> dict:
    """One state alone. job: images (folder), groups [{names, model, params, known_focal}], effort, out (folder),
    threads, seed.

    Writes out/model (COLMAP) and out/descriptors.npz (ids [P], mean descriptors [P, 128] uint8); returns counts.
    """
    import pycolmap

    out, effort = Path(job["out"]), Effort(**job["effort"])
    out.mkdir(parents=True, exist_ok=True)
    database = out / "database.db"
    database.unlink(missing_ok=True)
    pycolmap.Database.open(str(database)).close()
    pycolmap.set_random_seed(job["seed"])
    total = sum(len(g["names"]) for g in job["groups"])
    say(f"features of {total} photographs")
    for group in job["groups"]:
        _features(pycolmap, database, job, group, effort)
    _match(pycolmap, database, job, effort)
    best, models = _map(pycolmap, database, job, effort, total)
    if best is None:
        return {"registered": 0, "models": 0, "points": 0}
    folder = out / "model"
    folder.mkdir(exist_ok=True)
    best.write_binary(str(folder))
    _write_descriptors(pycolmap, database, best, out / "descriptors.npz")
    return {
        "registered": best.num_reg_images(), "models": models, "points": best.num_points3D(),
        "error": best.compute_mean_reprojection_error(),
    }  # fmt: skip


def _features(pycolmap, database: Path, job: dict, group: dict, effort: Effort) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads, options.use_gpu = effort.max_size, job["threads"], False
    options.sift.max_num_features, options.sift.first_octave = effort.features, effort.first_octave
    options.sift.peak_threshold = effort.peak
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = group["model"]
    if group["params"]:
        reader.camera_params = ",".join(repr(float(p)) for p in group["params"])
    photographs = {"image_names": group["names"], "camera_mode": pycolmap.CameraMode.SINGLE}
    # else they are numbered as features are done, on several threads in another order each time
    pycolmap.import_images(database, job["images"], options=reader, **photographs)
    pycolmap.extract_features(
        database,
        job["images"],
        **photographs,
        reader_options=reader,
        extraction_options=options,
        device=pycolmap.Device.cpu,
    )


def _match(pycolmap, database: Path, job: dict, effort: Effort) -> None:
    options, checks = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.num_threads, options.use_gpu = job["threads"], False
    checks.ransac.random_seed = job["seed"]  # else each thread draws on from the pair that it had before
    how = {"matching_options": options, "verification_options": checks, "device": pycolmap.Device.cpu}
    if not effort.preselect:
        say("matching every pair")
        pycolmap.match_exhaustive(database, **how)
        return
    pairs = _likely_pairs(pycolmap, database)
    say(f"matching {len(pairs)} pairs")
    listing = database.with_suffix(".pairs")
    listing.write_text("".join(f"{a} {b}\n" for a, b in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    pycolmap.match_image_pairs(database, pairing_options=pairing, **how)


def _likely_pairs(pycolmap, database: Path) -> list[tuple[str, str]]:
    """Names of the photographs that share large features (Wu 2013, doi:10.1109/3DV.2013.25, preemptive matching)."""
    with pycolmap.Database.open(str(database)) as db:
        images = sorted(db.read_all_images(), key=lambda i: i.name)
        strong = [_strongest(db, image.image_id) for image in images]
    votes = np.zeros((len(images), len(images)), int)
    for i, a in enumerate(strong):
        for j in range(i + 1, len(strong)):
            if len(a) and len(strong[j]):
                likeness = a @ strong[j].T
                forth, back = likeness.argmax(1), likeness.argmax(0)
                mutual = back[forth] == np.arange(len(a))
                # angle below 0.5 rad: descriptors of one thing from other sides
                votes[i, j] = votes[j, i] = int((mutual & (likeness.max(1) > 0.88)).sum())
    chosen = set()
    for i in range(len(images)):
        for j in np.argsort(-votes[i], kind="stable")[:PARTNERS]:
            if votes[i, j] >= MIN_VOTES:
                chosen.add((min(i, int(j)), max(i, int(j))))
        chosen |= {(i, i + k) for k in (1, 2) if i + k < len(images)}  # taken one after the other
    return [(images[i].name, images[j].name) for i, j in sorted(chosen)]


def _strongest(db, image_id: int) -> np.ndarray:
    keypoints, descriptors = np.asarray(db.read_keypoints(image_id)), _array(db.read_descriptors(image_id))
    if len(keypoints) == 0:
        return np.zeros((0, 128), np.float32)
    scale = np.hypot(keypoints[:, 2], keypoints[:, 4]) if keypoints.shape[1] == 6 else keypoints[:, 2]
    return _unit(descriptors[np.argsort(-scale, kind="stable")[:VOTERS]])


def _array(descriptors) -> np.ndarray:
    return np.asarray(getattr(descriptors, "data", descriptors))


def _unit(descriptors: np.ndarray) -> np.ndarray:
    d = descriptors.astype(np.float32)
    return d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-6)


def _map(pycolmap, database: Path, job: dict, effort: Effort, total: int):
    """(largest model or None, number of models)."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.extract_colors = ADJUSTING, job["seed"], True
    options.min_model_size, options.max_num_models, options.ba_use_gpu = 3, 8, False
    options.mapper.init_min_num_inliers, options.mapper.init_min_tri_angle = effort.init_inliers, effort.init_angle
    options.mapper.abs_pose_min_num_inliers = effort.pose_inliers
    done = {"count": 0}

    def one_more():
        done["count"] += 1
        if done["count"] % 10 == 0:
            say(f"placed {done['count']} of {total}")

    folder = Path(job["out"]) / "models"
    folder.mkdir(exist_ok=True)
    found = pycolmap.incremental_mapping(
        str(database), job["images"], str(folder), options=options, next_image_callback=one_more
    )
    if not found:
        return None, 0
    return max(found.values(), key=lambda r: (r.num_reg_images(), r.num_points3D())), len(found)


def _write_descriptors(pycolmap, database: Path, model, path: Path) -> None:
    """The mean descriptor of each point's observations."""
    ids = np.array(sorted(model.point3D_ids()), np.int64)
    total, count = np.zeros((len(ids), 128), np.float32), np.zeros(len(ids))
    with pycolmap.Database.open(str(database)) as db:
        for image in model.images.values():
            if not image.has_pose:
                continue
            point = np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], np.int64)
            seen = np.flatnonzero(point >= 0)
            rows = np.searchsorted(ids, point[seen])
            np.add.at(total, rows, _unit(_array(db.read_descriptors(image.image_id))[seen]))
            np.add.at(count, rows, 1)
    mean = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-6)
    np.savez(path, ids=ids, descriptors=np.rint(255 * np.clip(mean, 0, 1)).astype(np.uint8))


def adjust(job: dict) -> dict:
    """Bundle adjustment of the model in job['model'], written back. principal_point: whether it is refined too.  known:
    ids of points that stay where they are.  scale: of Cauchy's loss, pixels."""
    import pycolmap

    model = pycolmap.Reconstruction(job["model"])
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point, options.min_track_length, options.print_summary = job["principal_point"], 2, False
    ceres = options.ceres
    ceres.loss_function_type, ceres.loss_function_scale = pycolmap.LossFunctionType.CAUCHY, job["scale"]
    ceres.solver_options.num_threads, ceres.solver_options.max_num_iterations = ADJUSTING, job["iterations"]
    ceres.use_gpu = False
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    for point in job["known"]:
        if model.exists_point3D(point):
            config.add_constant_point(point)
    if not job["known"]:  # else these say where the model lies
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    model.write_binary(job["model"])
    return {"error": model.compute_mean_reprojection_error(), "points": model.num_points3D()}


TASKS = {"reconstruct": reconstruct, "adjust": adjust}


def default_effort(careful: bool) -> dict:
    """The settings of a job as plain numbers."""
    return asdict(CAREFUL if careful else FAST)


def main(path: str) -> int:
    try:
        import pycolmap
    except ImportError as err:
        print(f"pycolmap cannot be imported ({err})", file=sys.stderr)
        return 3
    pycolmap.logging.minloglevel = 1  # warnings and worse
    job = json.loads(Path(path).read_text())
    result = TASKS[job["task"]](job)
    Path(job["result"]).write_text(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
