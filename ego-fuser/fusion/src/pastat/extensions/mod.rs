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

/// Where the logit of the detector's class head is below this, a likelihood of 1 %, nothing is detected after the temporal
/// memory and the refinement either: without gradients neither looks there.
const LEAST_LIKELY: f32 = -4.6;
