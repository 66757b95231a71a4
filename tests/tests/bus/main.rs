//! Bus: publishers, subscribers, link emulation and replay through real zenoh sessions on loopback.

mod flood;
mod link;
mod recorder;
mod replay;
mod ros2;
mod ros2_frames;
mod ros2_robot;
mod ros2_robots;
mod sessions;
