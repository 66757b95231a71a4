//! Sites: occupied voxels of one level.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::hash::{BuildHasherDefault, Hasher};

/// Bits of a coordinate in a key.
const AXIS_BITS: u32 = 21;
/// Bound of the absolute value of coordinates on every axis.
const HALF_RANGE: i32 = 1 << (AXIS_BITS - 1);

/// Occupied voxels in the order of their first appearance, each once.
#[derive(Debug, Clone, Default)]
pub struct Sites {
    coords: Vec<[i32; 3]>,
    rows: HashMap<u64, u32, BuildHasherDefault<KeyHasher>>,
}

impl Sites {
    /// Sites from coordinates, and the row of each coordinate. Coordinates must be within 2^20 of zero
    /// ([`Self::holds`]).
    pub fn collect(coords: impl IntoIterator<Item = [i32; 3]>) -> (Self, Vec<u32>) {
        let mut sites = Self::default();
        let rows = coords.into_iter().map(|coord| sites.add(coord)).collect();
        (sites, rows)
    }

    /// Row of a coordinate, which becomes a site if it is none yet.
    pub fn add(&mut self, coord: [i32; 3]) -> u32 {
        match self.rows.entry(key(coord)) {
            Entry::Occupied(found) => *found.get(),
            Entry::Vacant(place) => {
                self.coords.push(coord);
                *place.insert(self.coords.len() as u32 - 1)
            }
        }
    }

    /// True if a coordinate is near enough to zero to be a site.
    pub fn holds(coord: [i32; 3]) -> bool {
        let mut axes = coord.iter();
        axes.all(|axis| (-HALF_RANGE..HALF_RANGE).contains(axis))
    }

    /// Number of sites.
    pub fn len(&self) -> usize {
        self.coords.len()
    }

    /// True if there is none.
    pub fn is_empty(&self) -> bool {
        self.coords.is_empty()
    }

    /// `[N]` of voxel indices x, y, z.
    pub fn coords(&self) -> &[[i32; 3]] {
        &self.coords
    }

    /// The row of a site.
    pub fn row(&self, coord: [i32; 3]) -> Option<u32> {
        // The key of a coordinate out of range is that of another site.
        let row = self.rows.get(&key(coord)).copied();
        row.filter(|_| Self::holds(coord))
    }

    /// The sites of the next level, one for every 2x2x2 voxels with a site in them, and the row in it of each site.
    pub fn halved(&self) -> (Self, Vec<u32>) {
        // The shift rounds down: voxels -2 and -1 share one, as 0 and 1 do.
        Self::collect(self.coords.iter().map(|coord| coord.map(|axis| axis >> 1)))
    }
}

fn key(coord: [i32; 3]) -> u64 {
    coord.into_iter().fold(0, |key, axis| {
        let axis_bits = axis.wrapping_add(HALF_RANGE) as u32 & ((1 << AXIS_BITS) - 1);
        key << AXIS_BITS | u64::from(axis_bits)
    })
}

/// Hash by one multiplication: the keys are coordinates, and the table is used for one sweep.
#[derive(Debug, Clone, Copy, Default)]
struct KeyHasher(u64);

impl Hasher for KeyHasher {
    fn write(&mut self, bytes: &[u8]) {
        bytes
            .iter()
            .for_each(|&byte| self.write_u64(u64::from(byte)));
    }

    fn write_u64(&mut self, value: u64) {
        let mixed = (self.0 ^ value).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        // Low bits of a product depend on low bits alone: the high ones are mixed into them.
        self.0 = mixed ^ (mixed >> 32);
    }

    fn finish(&self) -> u64 {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_site_is_found_once() {
        let (sites, rows) = Sites::collect([[3, -2, 1], [0, 0, 0], [3, -2, 1], [-1, 5, 7]]);
        assert_eq!(sites.coords(), [[3, -2, 1], [0, 0, 0], [-1, 5, 7]]);
        assert_eq!(rows, [0, 1, 0, 2]);
        assert_eq!(
            (sites.row([-1, 5, 7]), sites.row([3, -2, 2])),
            (Some(2), None)
        );
        let (halved, parents) = sites.halved();
        assert_eq!(
            (halved.coords(), parents.as_slice()),
            (
                [[1, -1, 0], [0, 0, 0], [-1, 2, 3]].as_slice(),
                [0, 1, 2].as_slice()
            )
        );
    }

    #[test]
    fn coordinates_beyond_the_range_are_no_sites() {
        let (sites, _) = Sites::collect([[0, 0, 0], [-HALF_RANGE, HALF_RANGE - 1, 1]]);
        assert!(
            !Sites::holds([HALF_RANGE, 0, 0]) && Sites::holds([-HALF_RANGE, HALF_RANGE - 1, 1])
        );
        assert_eq!(
            (
                sites.row([i32::MIN, 0, 0]),
                sites.row([0, 2 * HALF_RANGE, 0])
            ),
            (None, None)
        );
    }
}
