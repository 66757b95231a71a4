//! ROS 2 clients of other people, from PyPI, beside a vehicle: both directions.

use std::process::Command;

use tests::fleet::programs;
use tests::locks::exclusive_lock;

#[test]
fn clients_of_ros_2_find_the_numbers_of_the_run_and_are_its_lidar() {
    let _exclusive = exclusive_lock();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/tools/check_ros2.py");
    let python = std::env::var("V2V_PYTHON").unwrap_or_else(|_| "python3".into());
    let output = match Command::new(&python).arg(script).arg(programs()).output() {
        Ok(output) => output,
        Err(error) => return eprintln!("skipped: {python}: {error} (V2V_PYTHON names another)"),
    };
    let stderr = String::from_utf8_lossy(&output.stderr);
    if output.status.code() == Some(2) {
        return eprintln!("{}", stderr.trim());
    }
    assert!(output.status.success(), "{stderr}");
    println!("{}", String::from_utf8_lossy(&output.stdout));
}
