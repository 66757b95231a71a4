//! Extensions of PASTAT: steps that are not in the paper. Each but the ego's queries can be switched off in the
//! configuration, and each file states the gain where it was measured.
//!
//! | step | setting | off |
//! | --- | --- | --- |
//! | [`alignment_search`] | `fsa.search` | absent |
//! | [`pooled_history`] | `earlier_cells` | 1 |
//! | [`ego_queries`] | `rows` | never |
//! | [`temporal_memory`] | `recall` | absent, `--without temporal-memory` |
//! | [`map_refinement`] | `refine` | absent |

pub(super) mod alignment_search;
pub(super) mod ego_queries;
pub(super) mod map_refinement;
pub(super) mod pooled_history;
pub(super) mod temporal_memory;

/// Logit of the detector's class head, a likelihood of 1 %, below which temporal memory and refinement leave a map as it
/// is, without gradients: what they add there is no detection.
const LEAST_LIKELY: f32 = -4.6;
