//! Data sets: readers of recorded sweeps, generated scenes in every layout, road maps, alignment, what damaged data leaves.

mod alignment;
mod generated;
mod layouts;
mod left_out;
mod opendrive;
mod recorded;
