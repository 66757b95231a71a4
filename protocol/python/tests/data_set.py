"""Data sets on disk and recordings."""
import json
import os
import pickle
import shutil

import numpy as np
import v2vloc

from fleet import FRAMES


def test_a_generated_scene_has_clouds_poses_and_boxes(run):
    scene = v2vloc.read(run.scene)
    assert len(scene) == FRAMES and not scene.problems and len(scene.scenarios) == 1, scene
    assert scene[-1].tick == FRAMES - 1 == [frame.tick for frame in scene][-1]
    frame = scene[0]
    assert list(frame.agents)[0] == frame.ego and len(frame.agents) == 2, frame
    agent = frame.agents[frame.ego]
    assert agent.points.dtype == np.float32 and agent.points.shape[1] == 4 and len(agent.points) > 1000
    assert agent.world_from_lidar.dtype == np.float64
    np.testing.assert_allclose(agent.world_from_lidar[:3, :3] @ agent.world_from_lidar[:3, :3].T, np.eye(3), atol=1e-9)
    assert len(agent.objects) == len(agent.objects.ids) == len(agent.objects.classes) > 0
    assert agent.objects.boxes.shape == (len(agent.objects), 7)
    assert agent.pose is None and agent.bev is None and not frame.detections


def test_boxes_are_where_their_poses_are(run):
    agent = next(iter(v2vloc.read(run.scene, points=False)[0].agents.values()))
    lidar_from_object = np.linalg.inv(agent.world_from_lidar) @ agent.objects.world_from_object
    np.testing.assert_allclose(lidar_from_object[:, :3, 3], agent.objects.boxes[:, :3], atol=1e-6)
    assert agent.points is None


def test_ground_truth_merges_the_agents(run):
    frame = v2vloc.read(run.scene, points=False)[0]
    truth = frame.ground_truth()
    assert len(set(truth.ids)) == len(truth) > 0
    assert len(frame.ground_truth(area_m=(-10, -10, -3, 10, 10, 1))) < len(truth)
    other = list(frame.agents)[1]
    assert len(frame.ground_truth(other)) > 0
    for arguments, text in [({"protocol": "x"}, "unknown protocol"), ({"ego": "7"}, "no true pose of agent \"7\"")]:
        refuses(lambda: frame.ground_truth(**arguments), text)


def test_agents_that_do_not_take_part_annotate_nothing(run):
    scene = v2vloc.read(run.scene, points=False)
    frame = scene[0]
    assert scene.agents == {frame.source: list(frame.agents)}, scene.agents
    # Roadside units only: there are none.
    refuses(lambda: frame.ground_truth(protocol="v2xreal-i2i"), "no true pose of agent \"\"")
    alone = frame.ground_truth(frame.ego, protocol="v2xreal-i2i")
    assert 0 < len(alone) and set(alone.ids) <= set(frame.agents[frame.ego].objects.ids), alone


def test_frames_are_those_of_the_ego_of_the_protocol(run):
    root = run.work / "gaps"
    for cav, stems in (("both/1", range(3)), ("both/-1", range(1, 4)), ("single/1", range(3))):
        (root / cav).mkdir(parents=True)
        for stem in stems:
            (root / cav / f"{stem:06}.yaml").write_text("lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n")
            (root / cav / f"{stem:06}.pcd").write_text("")
    by_layout = v2vloc.read(root, points=False)
    by_units = v2vloc.read(root, points=False, protocol="v2xreal-i2i")
    assert [frame.ego for frame in by_units] == ["-1"] * 3 and by_layout[0].ego == "1"
    assert by_units[0].capture_time_ns > by_layout[0].capture_time_ns
    refuses(lambda: by_layout[0].ground_truth(protocol="v2xreal-i2i"), "read(path, protocol=\"v2xreal-i2i\")")
    assert by_units.scenarios == ["both"] and "without an ego of the protocol: single" in by_units.problems[-1]
    assert len(pickle.loads(pickle.dumps(by_units))[0].ground_truth()) == 0


def test_a_set_of_a_relative_path_is_read_from_any_folder(run):
    here = os.getcwd()
    os.chdir(run.scene.parent)
    scene = v2vloc.read(run.scene.name, points=False)
    os.chdir(here)
    assert scene[0].agents and not scene[0].problems


def test_what_is_no_area_is_refused(run):
    frame = v2vloc.read(run.scene, points=False)[0]
    for area_m in [(-51.2, 51.2, -38.4, 38.4, -3, 1), (np.nan,) * 6]:
        refuses(lambda: frame.ground_truth(area_m=area_m), "area_m: from ")


def test_boxes_of_a_ground_truth_are_read_only(run):
    frame = v2vloc.read(run.scene, points=False)[0]
    truth = frame.ground_truth()
    try:
        truth.boxes[:, 0] += 100
    except ValueError as error:
        assert "read-only" in str(error), error
    else:
        raise AssertionError("a ground truth was changed")
    frame.agents[frame.ego].objects.boxes[:, 0] += 100


def test_a_run_has_the_protocol_by_which_it_was_scored(run):
    folder = run.work / "scored"
    assert run.live and not folder.mkdir()
    shutil.copy(run.work / "runs/fleet/recording.mcap", folder)
    alone = v2vloc.read(folder)
    assert not alone.problems and {frame.ego for frame in alone} == {run.recording[0].ego}
    protocol = run.metrics["protocol"]
    near = {**protocol["ground_truth"], "x_m": [-10, 10]}
    (folder / "metrics.json").write_text(json.dumps({"protocol": {**protocol, "ground_truth": near}}))
    assert len(v2vloc.read(folder)[0].ground_truth()) < len(alone[0].ground_truth())
    (folder / "detections.jsonl").write_text("{")
    assert "detections.jsonl: " in v2vloc.read(folder).problems[0]


def test_a_copy_opens_the_scene_again(run):
    scene = v2vloc.read(run.scene, points=False)
    copy = pickle.loads(pickle.dumps(scene))
    assert len(copy) == len(scene) and copy[1].agents.keys() == scene[1].agents.keys()
    assert next(iter(copy[1].agents.values())).points is None


def test_a_recording_has_the_frames_of_the_live_run(run):
    assert len(run.recording) == FRAMES, run.recording
    live = {frame.capture_time_ns: frame for frame in run.live}
    for frame in run.recording:
        assert not frame.problems and frame.ego in frame.detections, frame
        same = live[frame.capture_time_ns]
        assert frame.tick == same.tick and frame.agents.keys() == same.agents.keys(), (frame, same)
        for cav, agent in frame.agents.items():
            assert agent.points is not None and same.agents[cav].points is None
            np.testing.assert_array_equal(agent.bev.features, same.agents[cav].bev.features)
            np.testing.assert_array_equal(agent.pose.world_from_cav, same.agents[cav].pose.world_from_cav)
        np.testing.assert_array_equal(frame.detections[frame.ego].boxes, same.detections[frame.ego].boxes)


def test_a_truncated_recording_is_read_up_to_its_end(run):
    whole = (run.work / "runs/fleet/recording.mcap").read_bytes()
    cut = run.work / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    data_set = v2vloc.read(cut)
    assert 0 < len(data_set) <= FRAMES and "bytes from byte" in data_set.problems[0], data_set.problems


def test_a_damaged_frame_keeps_its_other_parts(run):
    points = sorted(run.scene.rglob("*.pcd"))[0]
    whole = points.read_bytes()
    points.write_bytes(whole[:200])
    try:
        frame = v2vloc.read(run.scene)[0]
        assert len(frame.agents) == 1 and points.name in frame.problems[0], frame.problems
    finally:
        points.write_bytes(whole)


def test_what_cannot_be_opened_is_named(run):
    refuses(lambda: v2vloc.read(run.work / "nowhere"), "nowhere")
    empty = run.work / "empty"
    empty.mkdir()
    refuses(lambda: v2vloc.read(empty), "no supported layout")
    try:
        v2vloc.read(run.scene)[FRAMES]
    except IndexError as error:
        assert f"frame {FRAMES} of {FRAMES}" in str(error)
    else:
        raise AssertionError("no IndexError")


def refuses(action, text):
    try:
        action()
    except v2vloc.Error as error:
        assert isinstance(error, ValueError) and text in str(error), error
    else:
        raise AssertionError(f"no error with {text!r}")
