//! Data sets: readers of recorded sweeps, generated scenes in every layout, road maps, alignment, damaged data.

mod alignment;
mod digests;
mod generated;
mod layouts;
mod left_out;
mod opendrive;
mod recorded;
