//! Identity of the data of a training.

/// Identity of the data of a training, and the part of it that cannot be used.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DataListing {
    /// SHA-256 over names, agents, capture times and cheap digests of the files' contents: see
    /// `dataset::content_sha256`.
    pub sha256: String,
    /// Number of sweeps without a known pose.
    pub without_pose: usize,
    /// Problems of the folders: missing files, unsupported content.
    pub problems: Vec<String>,
}

impl DataListing {
    /// Text of the data that are left out; `None` if all can be used.
    pub fn left_out(&self) -> Option<String> {
        let sweeps = (self.without_pose > 0)
            .then(|| format!("{} sweeps without a pose left out", self.without_pose));
        let count = self.problems.len();
        let first = self.problems.first();
        let problems = first.map(|first| format!("{count} problems, the first: {first}"));
        let all: Vec<String> = sweeps.into_iter().chain(problems).collect();
        (!all.is_empty()).then(|| all.join("; "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_that_are_left_out_are_counted() {
        let whole = DataListing {
            sha256: "12ab".into(),
            ..DataListing::default()
        };
        assert_eq!(whole.left_out(), None);
        let problems = vec!["a.pcd: cut off".into(), "b.yaml: empty".into()];
        let lacking = DataListing {
            without_pose: 3,
            problems,
            ..whole
        };
        assert_eq!(
            lacking.left_out().unwrap(),
            "3 sweeps without a pose left out; 2 problems, the first: a.pcd: cut off"
        );
    }
}
