//! Statistics of a process as `diagnostic_msgs/DiagnosticArray`.

use crate::cdr;

/// Level of a status.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Level {
    /// Nothing to report.
    Ok = 0,
    /// Messages were lost.
    Warn = 1,
}

/// Status of one process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Status {
    pub(crate) level: Level,
    pub(crate) name: String,
    pub(crate) message: String,
    pub(crate) hardware_id: String,
    pub(crate) values: Vec<(String, String)>,
}

/// The status of some processes.
pub(crate) fn diagnostics(nanos: u64, status: &[Status]) -> Vec<u8> {
    cdr::message(|cdr| {
        cdr::header(cdr, nanos, "");
        cdr.write_sequence_length(status.len());
        for one in status {
            cdr.write_u8(one.level as u8);
            for text in [&one.name, &one.message, &one.hardware_id] {
                cdr.write_string(text);
            }
            cdr.write_sequence_length(one.values.len());
            for (key, value) in &one.values {
                cdr.write_string(key);
                cdr.write_string(value);
            }
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_laid_out_as_ros_lays_it_out() {
        let status = Status {
            level: Level::Warn,
            name: "n".into(),
            message: "lost".into(),
            hardware_id: String::new(),
            values: vec![("k".into(), "v".into())],
        };
        let mut expected = b"\0\x01\0\0\x01\0\0\0\x02\0\0\0\x01\0\0\0\0\0\0\0\x01\0\0\0".to_vec();
        expected.extend(b"\x01\0\0\0\x02\0\0\0n\0\0\0\x05\0\0\0lost\0\0\0\0\x01\0\0\0\0\0\0\0");
        expected.extend(b"\x01\0\0\0\x02\0\0\0k\0\0\0\x02\0\0\0v\0");
        assert_eq!(diagnostics(1_000_000_002, &[status]), expected);
    }
}
