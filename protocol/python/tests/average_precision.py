"""Average precision against the programs."""
import json

import numpy as np
import v2vloc

from data_set import refuses
from fleet import AREA_M, ROOT, call

THRESHOLDS = (0.3, 0.5, 0.7)
CAR = np.array([[10.0, 2.0, -1.0, 4.5, 1.9, 1.6, 0.1]])
FAR = CAR + [30, 0, 0, 0, 0, 0, 0]


def test_small_cases(run):
    assert v2vloc.average_precision([(CAR, [0.9])], [CAR]) == 1.0
    assert v2vloc.average_precision([(FAR, [0.9]), (CAR, [0.8])], [CAR, CAR], iou=0.5) == 0.25
    assert v2vloc.average_precision([([], [])], [CAR], iou=[0.5, 0.7]) == {0.5: 0.0, 0.7: 0.0}
    for frames, truth in (([(CAR, [0.9])], [[]]), ([], [])):
        assert v2vloc.average_precision(frames, truth) is None
        assert v2vloc.average_precision(frames, truth, iou=[0.5, 0.7]) == {0.5: None, 0.7: None}
    assert v2vloc.average_precision([(CAR, [0.9])], [CAR], iou=np.array([0.5])) == {0.5: 1.0}
    close = (np.concatenate([FAR, CAR]), [0.5, 0.5 + 1e-9])
    assert v2vloc.average_precision([close], [CAR]) == 1.0
    frames = [(FAR, [0.2]), (CAR, [0.9])]
    assert v2vloc.average_precision(frames, [[], CAR]) == 1.0
    assert v2vloc.average_precision(frames, [[], CAR], ordering="frame") == 0.5


def test_a_run_has_the_numbers_of_eval_and_of_its_metrics(run):
    detections = [frame.detections[frame.ego] for frame in run.recording]
    truth = [frame.ground_truth(area_m=AREA_M) for frame in run.recording]
    evaluated = json.loads(call("v2vloc", "eval", "--dataset", run.scene, "--weights", ROOT / "deploy/weights", "--method", "max",
                                "--dtype", "f16", "--json"))
    for ordering, name in (("global", "ap_global"), ("frame", "ap_frame_order")):
        found = v2vloc.average_precision(detections, truth, iou=THRESHOLDS, ordering=ordering)
        for iou in THRESHOLDS:
            assert found[iou] == run.metrics[name][str(iou)], (name, iou, found, run.metrics[name])
            assert found[iou] == evaluated[name][str(iou)], (name, iou, found, evaluated[name])


def test_detections_beyond_the_range_of_the_ground_truth_do_not_count(run):
    frame = run.recording[0]
    truth = frame.ground_truth(area_m=(-30, -30, -3, 30, 30, 1))
    assert 0 < len(truth) < len(frame.ground_truth(area_m=AREA_M))
    beyond = np.array([[31.0, 0.0, -1.0, 4.5, 1.9, 1.6, 0.0]])
    scores = np.concatenate([np.full(len(truth), 0.5), [0.9]])
    found = (np.concatenate([truth.boxes, beyond]), scores)
    assert v2vloc.average_precision([found], [truth]) == 1.0
    assert v2vloc.average_precision([found], [truth.boxes]) < 1.0


def test_wrong_arrays_are_named(run):
    cases = [
        (([(CAR, [0.9])], []), {}, "detections of 1 frames, truth of 0"),
        (([(CAR[:, :6], [0.9])], [CAR]), {}, "detections of frame 0: boxes of shape [1, 6], expected (N, 7)"),
        (([(CAR, [0.9, 0.8])], [CAR]), {}, "2 scores for 1 boxes"),
        (([(CAR, [np.nan])], [CAR]), {}, "score NaN"),
        (([(CAR, [0.9])], [CAR * np.inf]), {}, "truth of frame 0: a box with inf"),
        (([(CAR * [1, 1, 1, -1, 1, 1, 1], [0.9])], [CAR]), {}, "detections of frame 0: box 0 of size [-4.5, 1.9, 1.6] m"),
        (([CAR], [CAR]), {}, "expected Detections or (boxes, scores)"),
        (([], []), {"iou": 0}, "iou: 0, expected more than 0"),
        (([], []), {"ordering": "score"}, "ordering: \"score\""),
    ]
    for arguments, options, text in cases:
        refuses(lambda: v2vloc.average_precision(*arguments, **options), text)
