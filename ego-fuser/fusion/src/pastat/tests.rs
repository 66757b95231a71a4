use protocol::{BevGrid, Pose};
use tch::nn::VarStore;
use tch::{Device, Kind};

use super::config::{FsaConfig, Wavelengths};
use super::spatial_alignment::FineMaps;
use super::*;
use crate::classes::Classes;
use crate::full_resolution::FullResolutionMap;
use crate::maps::{EarlierMaps, MapMetadata, ReceivedMaps, larger_cells};
use crate::test_data::{redraw, uniform};
use crate::warp::WarpedMaps;

const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);
const GRID: BevGrid = BevGrid {
    x_min_m: -10.0,
    y_min_m: -6.0,
    cell_m: 1.0,
    width: 20,
    height: 12,
};

/// Synthetic entries.
struct Scene {
    features: Tensor,
    mask: Tensor,
    facts: Vec<MapMetadata>,
}

impl Scene {
    fn new(agent: &[usize], age_secs: &[f64]) -> Self {
        tch::set_num_threads(1);
        let entries = agent.len() as i64;
        let facts = agent.iter().zip(age_secs);
        let facts = facts.map(|(&agent, &age_secs)| MapMetadata {
            agent,
            // All senders are at the ego's pose: maps as received are equal to maps on the ego's grid.
            ego_from_cav: Pose::IDENTITY,
            confidence: 0.8,
            age_secs,
        });
        Self {
            features: uniform(9, &[entries, 4, 12, 20]),
            mask: Tensor::ones([entries, 1, 12, 20], FLOAT),
            facts: facts.collect(),
        }
    }

    fn fused(&self, pastat: &Pastat) -> Tensor {
        pastat.fuse(&self.aligned()).unwrap().map
    }

    /// The newest of each agent, and the rest pooled, as in `lean`.
    fn aligned(&self) -> AlignedMaps {
        self.aligned_with_cells_of(2)
    }

    fn aligned_with_cells_of(&self, cells: i64) -> AlignedMaps {
        let (newest, earlier): (Vec<usize>, Vec<usize>) =
            (0..self.facts.len()).partition(|&entry| {
                let mut before = self.facts[..entry].iter();
                before.all(|facts| facts.agent != self.facts[entry].agent)
            });
        let (newest, earlier) = (self.only(&newest), self.only(&earlier));
        let received = ReceivedMaps::new(
            newest.features.shallow_clone(),
            Some(newest.mask.shallow_clone()),
        );
        AlignedMaps {
            received,
            earlier: (!earlier.facts.is_empty()).then(|| earlier.pooled(cells)),
            is_training: true,
            ..AlignedMaps::newest(&newest.features, &newest.mask, &newest.facts, &GRID)
        }
    }

    fn pooled(&self, cells: i64) -> EarlierMaps {
        let maps = (0..self.facts.len() as i64).map(|entry| {
            let [map, sent] = [&self.features, &self.mask].map(|maps| maps.narrow(0, entry, 1));
            FullResolutionMap::of(&map, Some(&sent)).unwrap()
        });
        let head = VarStore::new(Device::Cpu);
        let classes = Classes::under(&head.root(), [4, 2]);
        redraw(&head, &["cls_head"], 1.0);
        let features = larger_cells(&self.features, cells).unwrap();
        let mask = larger_cells(&self.mask, cells).unwrap().ceil();
        EarlierMaps {
            warped: WarpedMaps { features, mask },
            metadata: self.facts.clone(),
            full_resolution: Some((maps.collect(), classes)),
        }
    }

    /// The same with these entries only, in this order.
    fn only(&self, entries: &[usize]) -> Self {
        let index: Vec<i64> = entries.iter().map(|&entry| entry as i64).collect();
        let index = Tensor::from_slice(&index);
        Self {
            features: self.features.index_select(0, &index),
            mask: self.mask.index_select(0, &index),
            facts: entries.iter().map(|&entry| self.facts[entry]).collect(),
        }
    }
}

/// Without the search, in which random maps match anywhere.
fn small() -> PastatConfig {
    let fsa = FsaConfig {
        alignment_search: None,
        ..FsaConfig::default()
    };
    PastatConfig {
        dim: 16,
        windows: vec![2, 4],
        fsa: Some(fsa),
        ..PastatConfig::lean(4)
    }
}

/// A module without neutral weights, as after a training.
fn trained(config: &PastatConfig) -> (VarStore, Pastat) {
    let variables = VarStore::new(Device::Cpu);
    let pastat = Pastat::new(&variables.root(), config).unwrap();
    redraw(&variables, &["weight"], 0.3);
    redraw(&variables, &["delta", "fit", "out", "cells", "conv1"], 0.35);
    (variables, pastat)
}

fn distance(a: &Tensor, b: &Tensor) -> f64 {
    (a - b).abs().max().double_value(&[])
}

#[test]
fn untrained_it_is_the_maximum_of_the_newest_maps() {
    for config in [
        small(),
        PastatConfig {
            patch: 1,
            earlier_cells: 1,
            ..small()
        },
    ] {
        let variables = VarStore::new(Device::Cpu);
        let pastat = Pastat::new(&variables.root(), &config).unwrap();
        let scene = Scene::new(&[0, 1, 2, 0, 1], &[0.0, 0.1, 0.0, 0.1, 0.2]);
        let newest = scene
            .features
            .narrow(0, 0, 3)
            .amax([0_i64].as_slice(), false);
        let fused = pastat
            .fuse(&scene.aligned_with_cells_of(config.earlier_cells))
            .unwrap()
            .map;
        assert!(distance(&fused, &newest) < 1e-4);
        let ego_only = Scene::new(&[0], &[0.0]);
        assert!(distance(&ego_only.fused(&pastat), &ego_only.features.get(0)) < 1e-6);
    }
}

#[test]
fn masked_entries_change_nothing_also_after_training() {
    let (_store, pastat) = trained(&PastatConfig {
        fsa: None,
        ..small()
    });
    let scene = Scene::new(&[0, 1, 2, 1], &[0.0, 0.1, 0.0, 0.2]);
    for entry in [1, 3] {
        let _ = scene.mask.get(entry).fill_(0.0);
    }
    let fused = scene.fused(&pastat);
    for entry in [1, 3] {
        let _ = scene.features.get(entry).fill_(5.0);
    }
    assert!(distance(&scene.fused(&pastat), &fused) < 1e-4);
    assert!(distance(&scene.only(&[0, 2]).fused(&pastat), &fused) < 1e-4);
    // A map with some cells counts only there.
    let _ = scene.mask.get(1).narrow(2, 0, 4).fill_(1.0);
    let near = scene.fused(&pastat);
    let _ = scene.features.get(1).narrow(2, 8, 12).fill_(-5.0);
    assert!(distance(&scene.fused(&pastat), &near) < 1e-4);
}

#[test]
fn the_order_of_neighbours_does_not_matter() {
    let (_store, pastat) = trained(&small());
    let scene = Scene::new(&[0, 1, 2, 0], &[0.0, 0.1, 0.0, 0.1]);
    assert!(
        distance(
            &scene.only(&[0, 3, 2, 1]).fused(&pastat),
            &scene.fused(&pastat)
        ) < 1e-4
    );
}

#[test]
fn each_switch_decides_whether_its_input_matters() {
    for (ce, te) in [(false, false), (true, false), (false, true)] {
        let te = te.then_some(Wavelengths::Printed);
        let is_timed = te.is_some();
        let (_store, pastat) = trained(&PastatConfig {
            ce,
            te,
            fsa: None,
            ..small()
        });
        let mut scene = Scene::new(&[0, 1], &[0.0, 0.1]);
        let fused = scene.fused(&pastat);
        scene.facts[1].confidence = 0.1;
        assert_eq!(
            distance(&scene.fused(&pastat), &fused) > 1e-5,
            ce,
            "confidence"
        );
        scene.facts[1].confidence = 0.8;
        scene.facts[1].age_secs = 0.4;
        assert_eq!(
            distance(&scene.fused(&pastat), &fused) > 1e-5,
            is_timed,
            "age"
        );
    }
    let [without_fsa, with_fsa] = [None, Some(FsaConfig::default())].map(|fsa| {
        let (store, _) = trained(&PastatConfig { fsa, ..small() });
        store.variables().len()
    });
    assert!(without_fsa < with_fsa);
}

#[test]
fn every_parameter_gets_a_gradient() {
    let (store, pastat) = trained(&small());
    let scene = Scene::new(&[0, 1, 2, 1], &[0.0, 0.1, 0.0, 0.2]);
    (scene.fused(&pastat) * (uniform(8, &[4, 12, 20]) - 0.5))
        .sum(Kind::Float)
        .backward();
    for (name, variable) in store.variables() {
        let gradient = variable.grad();
        assert!(gradient.defined(), "{name} has no gradient");
        let is_finite = gradient.isfinite().all().int64_value(&[]) == 1;
        assert!(
            is_finite && gradient.abs().max().double_value(&[]) > 0.0,
            "{name}"
        );
    }
}

/// The maps after FSA.
fn fine(pastat: &Pastat, maps: &AlignedMaps) -> FineMaps {
    let coarse = CoarseMaps::pick(maps, &pastat.config).unwrap();
    let confidences = pastat.confidence_embedding.embed(&coarse.origins).unwrap();
    let patches = pastat.patches.flatten(&coarse).unwrap();
    pastat
        .spatial_alignment
        .align(&coarse, patches, &confidences, &maps.grid, true)
        .unwrap()
        .0
}

#[test]
fn fsa_learns_a_shift_from_the_maps_only() {
    tch::manual_seed(7);
    let variables = VarStore::new(Device::Cpu);
    let config = PastatConfig {
        patch: 1,
        earlier_cells: 1,
        ..small()
    };
    let pastat = Pastat::new(&variables.root(), &config).unwrap();
    let mut optimizer =
        perception::train::AdamW::new(&variables, perception::train::AdamWConfig::default());
    // The neighbour's map is the ego's shifted by a cell; the target is one sharp map.
    let mut error = |step: u64, train: bool| {
        let mut scene = Scene::new(&[0, 1], &[0.0, 0.0]);
        let cells = uniform(step, &[1, 4, 12, 20]).gt(0.9).to_kind(Kind::Float) * 3.0;
        let shift = if step.is_multiple_of(2) { 1 } else { -1 };
        scene.features = Tensor::cat(&[&cells, &cells.roll([shift], [3])], 0);
        let fine = fine(&pastat, &scene.aligned_with_cells_of(1));
        let [moved, expected] = [fine.neighbours.maps().features.get(0), cells.get(0)]
            .map(|map| map.narrow(1, 2, 8).narrow(2, 4, 12));
        let loss = (moved - expected).square().mean(Kind::Float);
        if train {
            optimizer.zero_grad();
            loss.backward();
            optimizer.step(3e-3).unwrap();
        }
        loss.double_value(&[])
    };
    let before: f64 = (300..310).map(|step| error(step, false)).sum();
    (0..300).for_each(|step| {
        error(step, true);
    });
    let after: f64 = (300..310).map(|step| error(step, false)).sum();
    assert!(after < 0.5 * before, "{before} before, {after} after");
}

#[test]
fn the_memory_takes_of_earlier_maps_where_they_show_something() {
    let (_store, pastat) = trained(&PastatConfig {
        fsa: None,
        ..small()
    });
    let scene = Scene::new(&[0, 1, 0, 1, 0], &[0.0, 0.0, 0.1, 0.1, 0.2]);
    let fused = scene.fused(&pastat);
    let _ = scene.mask.get(4).fill_(0.0);
    let without = scene.fused(&pastat);
    assert!(distance(&fused, &without) > 1e-3);
    // Masked values are never read.
    let _ = scene.features.get(4).fill_(9.0);
    assert!(distance(&scene.fused(&pastat), &without) < 1e-4);
    assert!(distance(&scene.only(&[0, 1, 2, 3]).fused(&pastat), &without) < 1e-4);
    assert!(
        scene
            .only(&[0, 1])
            .fused(&pastat)
            .isfinite()
            .all()
            .int64_value(&[])
            == 1,
        "nothing to remember"
    );
}
