#!/usr/bin/env python3
"""Golden cases of tracking: synthetic tracks with the metrics of nuscenes-devkit 1.2.0, trackeval 1.3.0 and motmetrics
1.4.0, assignments by SciPy and a filter by filterpy.

    pip install scipy trackeval==1.3.0 motmetrics==1.4.0 filterpy==2.0.0 scikit-learn tqdm pyquaternion shapely cachetools
    pip install --no-deps nuscenes-devkit==1.2.0 "numpy<2" "pandas<2"   # pandas 2 lacks what motmetrics calls
    tests/golden/tracking/make_references.py     # writes the JSON files beside it; always the same
"""

import json
import math
import pathlib
import random

import motmetrics
import numpy as np
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import KalmanFilter
from nuscenes.eval.common.config import config_factory
from nuscenes.eval.tracking.algo import TrackingEvaluation
from nuscenes.eval.tracking.constants import AVG_METRIC_MAP
from nuscenes.eval.tracking.data_classes import TrackingBox, TrackingMetricData
from scipy.optimize import linear_sum_assignment
from trackeval.metrics import HOTA, Identity

FOLDER = pathlib.Path(__file__).resolve().parent
DISTANCE_M = 2.0


def sequence(draw, objects=5, frames=24, score=None, miss=0.0, switch=0.0, false=0.0, split=0.0, silent=(), hidden=(), noise=0.4):
    """Frames of [true id, x, y] and [track id, x, y, score]: objects that drive straight, and tracks of them."""
    starts = [(draw.uniform(-40, 40), draw.uniform(-20, 20), draw.uniform(-1, 1), draw.uniform(-1, 1)) for _ in range(objects)]
    owner = {k: 100 + k for k in range(objects)}
    scores = {100 + k: score if score is not None else draw.uniform(0.2, 0.95) for k in range(objects)}
    fresh = 500
    made = []
    for tick in range(frames):
        truth, tracks = [], []
        for k, (x, y, vx, vy) in enumerate(starts):
            if tick < k % 3 or (k, tick) in hidden:
                continue
            at = (x + vx * tick, y + vy * tick)
            truth.append([k, round(at[0], 3), round(at[1], 3)])
            if draw.random() < split:
                owner[k], fresh = fresh, fresh + 1
                scores[owner[k]] = score if score is not None else draw.uniform(0.2, 0.95)
            if draw.random() >= miss and tick not in silent:
                near = [round(value + draw.gauss(0, noise), 3) for value in at]
                tracks.append([owner[k], *near])
        if len(owner) > 1 and draw.random() < switch:
            a, b = draw.sample(sorted(owner), 2)
            owner[a], owner[b] = owner[b], owner[a]
        while draw.random() < false:
            fresh += 1
            scores[fresh] = score if score is not None else draw.uniform(0.05, 0.6)
            tracks.append([fresh, round(draw.uniform(-40, 40), 3), round(draw.uniform(-20, 20), 3)])
        # Scores vary from frame to frame: the mean of a track counts.
        vary = (lambda s: round(min(1.0, max(0.01, s + draw.uniform(-0.1, 0.1))), 4)) if score is None else (lambda s: s)
        made.append({"truth": truth, "tracks": [[i, x, y, vary(scores[i])] for i, x, y in tracks]})
    return made


def far(frames):
    """The same with every track out of reach."""
    return [{"truth": f["truth"], "tracks": [[i, x + 500, y, s] for i, x, y, s in f["tracks"]]} for f in frames]


def without(frames, part):
    return [{**frame, part: []} for frame in frames]


def cases():
    draw = random.Random(20260)
    normal = {"miss": 0.15, "switch": 0.15, "false": 0.3, "split": 0.03}
    hidden = {(k, tick) for k in (0, 2) for tick in range(8, 13)} | {(1, tick) for tick in range(24)}
    return {
        "exact": [sequence(draw, noise=0.0)],
        "no_tracks": [without(sequence(draw, frames=8), "tracks")],
        "no_objects": [without(sequence(draw, frames=8), "truth")],
        "all_out_of_reach": [far(sequence(draw, frames=8))],
        "switches": [sequence(draw, switch=0.5)],
        "fragments": [sequence(draw, miss=0.4)],
        "new_identities": [sequence(draw, split=0.15)],
        "false_positives": [sequence(draw, false=0.7)],
        "equal_scores": [sequence(draw, score=0.5, **normal)],
        "silent_frames": [sequence(draw, silent=range(5, 11), **normal)],
        "objects_that_leave_and_return": [sequence(draw, hidden=hidden, **normal)],
        "beside_each_other": [sequence(draw, objects=9, frames=30, noise=1.2, **normal)],
        "three_sequences": [sequence(draw, objects=n, frames=20, **normal) for n in (3, 6, 8)],
        "one_sequence_without_tracks_one_without_objects": [
            sequence(draw, frames=12, **normal), without(sequence(draw, frames=6), "tracks"), without(sequence(draw, frames=6), "truth")],
        "low_recall": [sequence(draw, objects=8, miss=0.85, false=0.2)],
    }


def with_mean_scores(frames):
    of_track = {}
    for frame in frames:
        for track, _, _, score in frame["tracks"]:
            of_track.setdefault(track, []).append(score)
    mean = {track: float(np.mean(scores)) for track, scores in of_track.items()}
    return [{**frame, "tracks": [[i, x, y, mean[i]] for i, x, y, _ in frame["tracks"]]} for frame in frames]


def number(value):
    return None if value is None or math.isnan(value) else float(value)


def nuscenes(sequences):
    config = config_factory("tracking_nips_2019")
    TrackingMetricData.set_nelem(config.num_thresholds)
    true, found = {}, {}
    for index, frames in enumerate(sequences):
        box = lambda i, x, y, score: TrackingBox(translation=(x, y, 0), tracking_id=str(i), tracking_name="car", tracking_score=float(score))
        true[f"s{index}"] = {t: [box(i, x, y, -1.0) for i, x, y in f["truth"]] for t, f in enumerate(frames)}
        found[f"s{index}"] = {t: [box(*point) for point in f["tracks"]] for t, f in enumerate(with_mean_scores(frames))}
    data = TrackingEvaluation(true, found, "car", config.dist_fcn_callable, config.dist_th_tp, config.min_recall,
                              config.num_thresholds, config.metric_worst, verbose=False).accumulate()
    result = {}
    for name, averaged in AVG_METRIC_MAP.items():
        values = np.array(data.get_metric(averaged))
        worst = config.metric_worst[name]
        result[name] = None if np.all(np.isnan(values)) else number(np.mean(np.where(np.isnan(values), worst, values)))
    has_matches = not np.all(np.isnan(data.confidence))
    if has_matches:
        best = int(np.nanargmax(data.mota))
        for name in ("mota", "motp", "recall", "mt", "ml", "fp", "fn", "ids", "frag", "tp", "confidence"):
            result[name] = number(np.array(getattr(data, name))[best])
    return result


def distances(frame):
    true = np.array([[x, y] for _, x, y in frame["truth"]]).reshape(-1, 2)
    found = np.array([[x, y] for _, x, y, _ in frame["tracks"]]).reshape(-1, 2)
    return np.linalg.norm(true[:, None] - found[None], axis=2)


def mot(sequences):
    accumulators = []
    for frames in sequences:
        accumulator = motmetrics.MOTAccumulator()
        for tick, frame in enumerate(frames):
            between = distances(frame)
            between[between >= DISTANCE_M] = np.nan
            accumulator.update([o[0] for o in frame["truth"]], [t[0] for t in frame["tracks"]], between, frameid=tick)
        accumulators.append(accumulator)
    names = ["mota", "motp", "num_switches", "num_fragmentations", "mostly_tracked", "mostly_lost", "num_false_positives",
             "num_misses", "num_matches", "recall", "idf1"]
    merged = motmetrics.MOTAccumulator.merge_event_dataframes(accumulators)
    summary = motmetrics.metrics.create().compute(merged, metrics=names, name="all")
    return {name: None if not np.isfinite(summary[name].iloc[0]) else float(summary[name].iloc[0]) for name in names}


def trackeval_data(frames):
    true_ids = sorted({o[0] for f in frames for o in f["truth"]})
    track_ids = sorted({t[0] for f in frames for t in f["tracks"]})
    return {
        "num_gt_dets": sum(len(f["truth"]) for f in frames),
        "num_tracker_dets": sum(len(f["tracks"]) for f in frames),
        "num_gt_ids": len(true_ids),
        "num_tracker_ids": len(track_ids),
        "num_timesteps": len(frames),
        "gt_ids": [np.array([true_ids.index(o[0]) for o in f["truth"]], dtype=int) for f in frames],
        "tracker_ids": [np.array([track_ids.index(t[0]) for t in f["tracks"]], dtype=int) for f in frames],
        "similarity_scores": [np.maximum(0, 1 - distances(f) / DISTANCE_M) for f in frames],
    }


def trackeval(sequences):
    # Every similarity above 0 can match: a distance below 2 m.
    metrics = {"hota": HOTA(), "identity": Identity({"THRESHOLD": 1e-12, "PRINT_CONFIG": False})}
    combined = {}
    for name, metric in metrics.items():
        each = {str(index): metric.eval_sequence(trackeval_data(frames)) for index, frames in enumerate(sequences)}
        combined[name] = metric.combine_sequences(each)
    means = {name: float(np.mean(combined["hota"][key])) for name, key in (("hota", "HOTA"), ("det_a", "DetA"), ("ass_a", "AssA"))}
    return {**means, "idf1": float(combined["identity"]["IDF1"])}


def metrics():
    made = {}
    for name, sequences in cases().items():
        references = {"nuscenes": nuscenes(sequences), "motmetrics": mot(sequences), "trackeval": trackeval(sequences)}
        made[name] = {"sequences": sequences, **references}
    return made


def assignments():
    """Lowest total costs of matrices of numbers 0..10000 from a linear congruential generator."""
    state = 1

    def draw(below):
        nonlocal state
        state = (state * 6364136223846793005 + 1442695040888963407) % 2**64
        return (state >> 33) % below

    totals = []
    for _ in range(10_000):
        rows, columns = draw(12) + 1, draw(12) + 1
        costs = np.array([[draw(10_000) for _ in range(columns)] for _ in range(rows)])
        totals.append(int(costs[linear_sum_assignment(costs)].sum()))
    return {"seed": 1, "totals": totals}


def filter_steps():
    draw = np.random.default_rng(7)
    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.H = np.eye(2, 4)
    start, noise = draw.normal(0, 20, 2), np.array([[0.3, 0.05], [0.05, 0.2]])
    kalman.x = np.array([*start, 0.0, 0.0])
    kalman.P = np.block([[noise, np.zeros((2, 2))], [np.zeros((2, 2)), np.eye(2) * 100.0]])
    steps = []
    for _ in range(25):
        elapsed = float(draw.choice([0.05, 0.1, 0.1, 0.3]))
        axis = Q_discrete_white_noise(2, dt=elapsed, var=4.0**2)
        kalman.F = np.array([[1, 0, elapsed, 0], [0, 1, 0, elapsed], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        kalman.Q = np.kron(axis, np.eye(2))
        kalman.predict()
        root = draw.normal(0, 0.4, (2, 2))
        noise = root @ root.T + np.eye(2) * 0.04
        measured = start + draw.normal(0, 1.0, 2)
        step = {"elapsed_s": elapsed, "measured": measured.tolist(), "noise": noise.tolist()}
        kalman.update(measured, R=noise)
        steps.append({**step, "mahalanobis_squared": float(kalman.mahalanobis) ** 2, "state": kalman.x.tolist(), "covariance": kalman.P.tolist()})
    return {"start": start.tolist(), "start_noise": [[0.3, 0.05], [0.05, 0.2]], "sigma_mps": 10.0, "acceleration_mps2": 4.0, "steps": steps}


for file, content in (("metrics", metrics()), ("assignments", assignments()), ("filter", filter_steps())):
    (FOLDER / f"{file}.json").write_text(json.dumps(content, separators=(",", ":")) + "\n")
