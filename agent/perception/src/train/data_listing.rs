//! Which data a training learns from.

/// Which data a training learns from, and what of it cannot be used.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct DataListing {
    /// SHA-256 over names, agents, capture times and cheap digests of what the files hold: see
    /// [`content_sha256`](dataset::content_sha256).
    pub sha256: String,
    /// Sweeps whose pose is not known.
    pub without_pose: usize,
    /// What is wrong with the folders: missing files, what is not understood.
    pub problems: Vec<String>,
}

impl DataListing {
    /// Says what is left out; nothing where all can be used.
    #[must_use]
    pub fn left_out(&self) -> Option<String> {
        let sweeps = (self.without_pose > 0).then(|| format!("{} sweeps without a pose left out", self.without_pose));
        let problems =
            self.problems.first().map(|first| format!("{} problems, the first: {first}", self.problems.len()));
        let all: Vec<String> = sweeps.into_iter().chain(problems).collect();
        (!all.is_empty()).then(|| all.join("; "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_out_is_said_with_its_count() {
        let whole = DataListing { sha256: "12ab".into(), ..DataListing::default() };
        assert_eq!(whole.left_out(), None);
        let problems = vec!["a.pcd: cut off".into(), "b.yaml: empty".into()];
        let lacking = DataListing { without_pose: 3, problems, ..whole };
        assert_eq!(
            lacking.left_out().unwrap(),
            "3 sweeps without a pose left out; 2 problems, the first: a.pcd: cut off"
        );
    }
}
