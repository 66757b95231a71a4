//! ROS 2 clients of other people, from PyPI, beside a vehicle: both directions.

use std::process::Command;

use tests::fleet::programs;
use tests::locks::exclusive_lock;

#[test]
#[ignore = "needs zenoh-ros2-sdk, pamoja-ros2 and rosbags from PyPI in the Python that V2V_PYTHON names"]
fn clients_of_ros_2_find_the_numbers_of_the_run_and_are_its_lidar() {
    let _exclusive = exclusive_lock();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/tools/check_ros2.py");
    let python = std::env::var("V2V_PYTHON").unwrap_or_else(|_| "python3".into());
    let output = Command::new(&python)
        .arg(script)
        .arg(programs())
        .output()
        .expect("a Python interpreter");
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}: {stderr}", output.status);
    println!("{}", String::from_utf8_lossy(&output.stdout));
}
