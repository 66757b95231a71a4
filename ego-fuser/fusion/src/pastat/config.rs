//! Sizes and switches of PASTAT.

use perception::model_config::ConfigError;
use protocol::config::{FieldError, require, within};
use serde::{Deserialize, Serialize};

use super::spatial_alignment::correlation::PARTS;

/// Tokens that are queries in the attention over agents and time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Rows {
    /// Those of the ego's newest map: only they are used in the end. Maps of others are unchanged.
    Ego,
}

/// Wavelengths of the temporal encoding as a function of the channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Wavelengths {
    /// `2k / D` for the sine (Eq. 11) and `(2k + 1) / D` for the cosine (Eq. 12), as the paper prints them.
    Printed,
}

/// Feature Spatial Alignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FsaConfig {
    /// Channels in which maps are compared.
    pub matching: i64,
    /// Largest offset between compared cells, cells along x and along y.
    pub radius: i64,
    /// Neurons of the fully connected layer.
    pub hidden: i64,
    /// Largest shift of one comparison along x or y, metres.
    pub max_shift_m: f64,
    /// Largest rotation of one comparison, radians.
    pub max_turn_rad: f64,
    /// The search for maps with a larger offset; absent: such maps are not moved.
    #[serde(default, rename = "search")]
    pub alignment_search: Option<SearchConfig>,
}

/// The search for a map with a large offset from its pose.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SearchConfig {
    /// Edge of the squares of cells that are pooled, cells.
    pub cells: i64,
    /// Largest offset of the search, pooled cells along x and along y.
    pub radius: i64,
    /// In training a map is moved when its correlation with the ego's is higher elsewhere by more than this. After
    /// training, any higher correlation leads to a fine comparison at both places.
    pub margin: f64,
}

impl Default for FsaConfig {
    fn default() -> Self {
        Self {
            matching: 4,
            radius: 4,
            hidden: 64,
            max_shift_m: 3.0,
            max_turn_rad: 5.0_f64.to_radians(),
            alignment_search: Some(SearchConfig {
                cells: 4,
                radius: 9,
                margin: 0.1,
            }),
        }
    }
}

/// Temporal feature memory: earlier maps, blended in cell by cell.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct MemoryConfig {
    /// Channels of the layer that predicts the weight of an earlier map.
    pub hidden: i64,
    /// Share of all tokens' patches that are blended, those where vehicles are most likely.
    pub share: f64,
}

/// A PASTAT from its tokens to its output. `ce`, `fsa`, `te`, `temporal_memory` and `frames` are the switches of
/// the ablation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PastatConfig {
    /// Channels of the maps.
    pub channels: i64,
    /// Cells along each edge of a token.
    pub patch: i64,
    /// Channels of a token, the D of the paper.
    pub dim: i64,
    /// Heads of every attention.
    pub heads: i64,
    /// Blocks of attention and MLP, the L of the paper.
    pub depth: usize,
    /// Channels inside the MLP, in multiples of `dim`.
    pub mlp_ratio: i64,
    /// Edges of the attention windows, tokens; each has its equal share of the heads.
    pub windows: Vec<i64>,
    /// Tokens that are queries.
    pub rows: Rows,
    /// Channels inside the two convolutions that refine the fused map; absent: no refinement.
    #[serde(default, rename = "refine")]
    pub map_refinement: Option<i64>,
    /// Blending of earlier maps into the newest; absent: they take part through their tokens only.
    #[serde(default, rename = "recall", skip_serializing_if = "Option::is_none")]
    pub temporal_memory: Option<MemoryConfig>,
    /// Time steps wanted of every agent, the T of the paper.
    pub frames: usize,
    /// Edge of the squares of cells that are pooled in earlier maps before the warp: maps a few steps old do not need
    /// full resolution.
    pub earlier_cells: i64,
    /// Time from one step to the next in the temporal encoding, seconds.
    pub frame_secs: f64,
    /// True if poses' confidences are embedded (Eq. 7).
    pub ce: bool,
    /// Feature Spatial Alignment; absent: maps are aligned by their poses only.
    pub fsa: Option<FsaConfig>,
    /// Temporal encoding (Eq. 10-12); absent: the age of a map is not encoded.
    pub te: Option<Wavelengths>,
}

impl PastatConfig {
    /// Sized for one core and live traffic.
    pub(crate) fn lean(channels: i64) -> Self {
        Self {
            channels,
            patch: 2,
            dim: 32,
            heads: 4,
            depth: 1,
            mlp_ratio: 2,
            windows: vec![4, 8],
            rows: Rows::Ego,
            map_refinement: Some(96),
            temporal_memory: Some(MemoryConfig {
                hidden: 24,
                share: 0.125,
            }),
            frames: 3,
            earlier_cells: 2,
            frame_secs: 0.1,
            ce: true,
            fsa: Some(FsaConfig::default()),
            te: Some(Wavelengths::Printed),
        }
    }

    /// Sized like the transformer that the paper builds on.
    pub(crate) fn full(channels: i64) -> Self {
        Self {
            patch: 1,
            dim: channels,
            heads: 8,
            depth: 3,
            map_refinement: Some(channels),
            temporal_memory: None,
            earlier_cells: 1,
            fsa: Some(FsaConfig {
                matching: 16,
                ..FsaConfig::default()
            }),
            ..Self::lean(channels)
        }
    }

    /// Maps are padded to multiples of this many cells, so that tokens fill every window and cells fill every part of
    /// FSA.
    pub(crate) fn padding_cells(&self) -> i64 {
        let parts = match self.fsa.as_ref().map(|fsa| fsa.alignment_search) {
            Some(Some(search)) => PARTS * lcm(search.cells, self.earlier_cells),
            Some(None) => PARTS * self.earlier_cells,
            None => 1,
        };
        let windows = self.patch * self.windows.iter().copied().fold(1, lcm);
        lcm(windows, parts)
    }

    /// Checks that a module can be built.
    ///
    /// # Errors
    /// [`ConfigError`] names the field, its value and what it must be.
    pub(crate) fn validate(&self) -> Result<(), ConfigError> {
        for (field, value, most) in [
            ("pastat channels", self.channels, 4096),
            ("pastat patch", self.patch, 16),
            ("pastat dim", self.dim, 1024),
            ("pastat heads", self.heads, 64),
            ("pastat mlp_ratio", self.mlp_ratio, 16),
            ("pastat depth", self.depth as i64, 32),
            ("pastat refine", self.map_refinement.unwrap_or(1), 4096),
            ("pastat frames", self.frames as i64, 16),
        ] {
            within(field, value, 1, most)?;
        }
        let cells = self.earlier_cells;
        let is_divisor = cells >= 1 && self.patch % cells == 0;
        let rule = "must be a divisor of the patch";
        require(is_divisor, "pastat earlier_cells", cells, rule)?;
        let is_multiple = self.dim % (2 * self.heads) == 0;
        let rule = "must be a multiple of twice the heads";
        require(is_multiple, "pastat dim", self.dim, rule)?;
        let sizes = self.windows.len() as i64;
        let are_windows = sizes > 0
            && self.heads % sizes == 0
            && self.windows.iter().all(|size| (1..=32).contains(size));
        let rule = "must be 1 to 32 tokens each, sharing the heads";
        require(are_windows, "pastat windows", &self.windows, rule)?;
        within("pastat frame_secs", self.frame_secs, 1e-3, 10.0)?;
        if let Some(memory) = self.temporal_memory {
            let rule = "must be 2 or more, as earlier maps are blended in";
            require(self.frames >= 2, "pastat frames", self.frames, rule)?;
            memory.validate()?;
        }
        let Some(fsa) = &self.fsa else { return Ok(()) };
        fsa.validate()?;
        if let Some(search) = fsa.alignment_search {
            let is_multiple = search.cells % self.earlier_cells == 0;
            let rule = "must be a multiple of earlier_cells";
            require(is_multiple, "pastat fsa search cells", search.cells, rule)?;
        }
        Ok(())
    }
}

impl MemoryConfig {
    fn validate(&self) -> Result<(), FieldError> {
        within("pastat temporal memory hidden", self.hidden, 1, 4096)?;
        let is_share = self.share > 0.0 && self.share <= 1.0;
        let rule = "must be above 0, up to 1";
        require(is_share, "pastat temporal memory share", self.share, rule)
    }
}

impl FsaConfig {
    fn validate(&self) -> Result<(), FieldError> {
        within("pastat fsa matching", self.matching, 1, 256)?;
        within("pastat fsa hidden", self.hidden, 1, 4096)?;
        within("pastat fsa radius", self.radius, 0, 8)?;
        within("pastat fsa max_shift_m", self.max_shift_m, 0.0, 50.0)?;
        within("pastat fsa max_turn_rad", self.max_turn_rad, 0.0, 1.6)?;
        if let Some(search) = self.alignment_search {
            within("pastat fsa search cells", search.cells, 1, 16)?;
            within("pastat fsa search radius", search.radius, 1, 32)?;
            within("pastat fsa search margin", search.margin, 0.0, 2.0)?;
        }
        Ok(())
    }
}

fn lcm(a: i64, b: i64) -> i64 {
    let (mut rest, mut divisor) = (a, b);
    while rest != 0 {
        (rest, divisor) = (divisor % rest, rest);
    }
    a / divisor.max(1) * b
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with_memory(memory: MemoryConfig) -> PastatConfig {
        PastatConfig {
            temporal_memory: Some(memory),
            ..PastatConfig::lean(64)
        }
    }

    #[test]
    fn presets_are_valid_and_come_back_from_json() {
        for config in [PastatConfig::lean(64), PastatConfig::full(256)] {
            config.validate().unwrap();
            let text = serde_json::to_string(&config).unwrap();
            assert_eq!(serde_json::from_str::<PastatConfig>(&text).unwrap(), config);
        }
        assert_eq!(PastatConfig::lean(64).padding_cells(), 16);
        assert_eq!(
            PastatConfig {
                windows: vec![4, 6],
                ..PastatConfig::lean(64)
            }
            .padding_cells(),
            48
        );
    }

    #[test]
    fn invalid_settings_are_named() {
        for (config, part) in [
            (
                PastatConfig {
                    dim: 36,
                    ..PastatConfig::lean(64)
                },
                "dim is 36",
            ),
            (
                PastatConfig {
                    windows: vec![4, 8, 16],
                    ..PastatConfig::lean(64)
                },
                "windows is [4, 8, 16]",
            ),
            (
                PastatConfig {
                    earlier_cells: 3,
                    ..PastatConfig::lean(64)
                },
                "earlier_cells is 3",
            ),
            (
                PastatConfig {
                    fsa: Some(FsaConfig {
                        alignment_search: Some(SearchConfig {
                            cells: 3,
                            radius: 9,
                            margin: 0.1,
                        }),
                        ..FsaConfig::default()
                    }),
                    ..PastatConfig::lean(64)
                },
                "search cells is 3",
            ),
            (
                PastatConfig {
                    frames: 1,
                    ..PastatConfig::lean(64)
                },
                "frames is 1",
            ),
            (
                with_memory(MemoryConfig {
                    hidden: 0,
                    share: 0.125,
                }),
                "temporal memory hidden is 0",
            ),
            (
                with_memory(MemoryConfig {
                    hidden: 24,
                    share: f64::NAN,
                }),
                "temporal memory share is NaN",
            ),
            (
                PastatConfig {
                    frames: 0,
                    ..PastatConfig::lean(64)
                },
                "frames is 0",
            ),
            (
                PastatConfig {
                    frame_secs: f64::NAN,
                    ..PastatConfig::lean(64)
                },
                "frame_secs is NaN",
            ),
        ] {
            let message = config.validate().unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
        let text = serde_json::to_string(&PastatConfig::lean(64))
            .unwrap()
            .replace("\"ce\"", "\"cf\"");
        assert!(
            serde_json::from_str::<PastatConfig>(&text)
                .unwrap_err()
                .to_string()
                .contains("cf")
        );
    }
}
