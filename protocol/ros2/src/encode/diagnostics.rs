//! Statistics of a process as `diagnostic_msgs/DiagnosticArray`.

use crate::cdr;

/// Status of one process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Status {
    /// Level `WARN`, as messages were lost; else `OK`.
    pub(crate) is_warning: bool,
    pub(crate) name: String,
    pub(crate) message: String,
    pub(crate) hardware_id: String,
    pub(crate) values: Vec<(String, String)>,
}

/// The status of a process.
pub(crate) fn diagnostics(nanos: u64, status: &Status) -> Vec<u8> {
    cdr::message(|cdr| {
        cdr::header(cdr, nanos, "");
        cdr.write_sequence_length(1);
        cdr.write_u8(status.is_warning.into());
        for text in [&status.name, &status.message, &status.hardware_id] {
            cdr.write_string(text);
        }
        cdr.write_sequence_length(status.values.len());
        for (key, value) in &status.values {
            cdr.write_string(key);
            cdr.write_string(value);
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_laid_out_as_ros_lays_it_out() {
        let status = Status {
            is_warning: true,
            name: "n".into(),
            message: "lost".into(),
            hardware_id: String::new(),
            values: vec![("k".into(), "v".into())],
        };
        let mut expected = b"\0\x01\0\0\x01\0\0\0\x02\0\0\0\x01\0\0\0\0\0\0\0\x01\0\0\0".to_vec();
        expected.extend(b"\x01\0\0\0\x02\0\0\0n\0\0\0\x05\0\0\0lost\0\0\0\0\x01\0\0\0\0\0\0\0");
        expected.extend(b"\x01\0\0\0\x02\0\0\0k\0\0\0\x02\0\0\0v\0");
        assert_eq!(diagnostics(1_000_000_002, &status), expected);
    }
}
