//! CDR, the encoding of ROS 2 messages: classic, little-endian when written, of either byte order when read.

use protocol::Pose;
use re_cdr::{CdrWriter, LittleEndian};

/// Writer of ROS 2 messages.
pub(crate) type Cdr<'a> = CdrWriter<'a, LittleEndian>;

/// Encapsulation header: plain CDR, little-endian, no options.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// A message that `write` writes, after its encapsulation header.
pub(crate) fn message(write: impl FnOnce(&mut Cdr<'_>)) -> Vec<u8> {
    let mut cdr = HEADER.to_vec();
    write(&mut CdrWriter::new(&mut cdr));
    cdr
}

/// `std_msgs/Header`.
pub(crate) fn header(cdr: &mut Cdr<'_>, nanos: u64, frame_id: &str) {
    time(cdr, nanos);
    cdr.write_string(frame_id);
}

/// `builtin_interfaces/Time`.
pub(crate) fn time(cdr: &mut Cdr<'_>, nanos: u64) {
    // Seconds beyond 2038 do not fit into the message.
    cdr.write_i32(i32::try_from(nanos / 1_000_000_000).unwrap_or(i32::MAX));
    cdr.write_u32((nanos % 1_000_000_000) as u32);
}

/// `geometry_msgs/Pose` or `Transform`.
pub(crate) fn pose(cdr: &mut Cdr<'_>, pose: &Pose) {
    let [w, x, y, z] = pose.rotation_wxyz;
    f64s(cdr, &pose.translation_m);
    f64s(cdr, &[x, y, z, w]);
}

/// `float64[N]`.
pub(crate) fn f64s(cdr: &mut Cdr<'_>, values: &[f64]) {
    values.iter().for_each(|value| cdr.write_f64(*value));
}
