//! Fleets: replay, agents and ego together, live and in simulation time, in one process and in several.

mod boxes_beside_maps;
mod compressor;
mod in_process;
mod live_figures;
mod localization;
mod pace;
mod processes;
mod ros2_clients;
mod scripts;
mod shared_encoder;
mod simulation_time;
