//! Faults: crashed processes, cut connections, full disks and damaged inputs. Every test holds the exclusive lock.

mod damaged_inputs;
mod failed_parts;
mod poisoned_router;
mod processes;
mod receivers;
mod shared_memory;
mod silent_router;

use peak_alloc::PeakAlloc;

/// Counts memory for `damaged_inputs`; an allocator is global to the program.
#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;
