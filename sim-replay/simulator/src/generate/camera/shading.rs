//! Shading of a camera image: material, sun and air along the ray of every pixel.

use nalgebra::{Matrix3, Vector3};

use super::Surroundings;
use super::ground_paint::GroundPaint;
use super::paint::{Colour, Paint, SNOW, mix};
use crate::generate::raycast::{Caster, ColumnPose, Course, GROUND, MISS, RangeImage};
use crate::generate::weather::Weather;
use support::random::SplitMix64;

/// Direction towards the sun in the world.
const SUN: [f32; 3] = [0.53, -0.33, 0.78];
/// Share of the light that comes from the sky.
const AMBIENT: f32 = 0.45;
const WINDOW: Colour = [0.16, 0.20, 0.26];
const ZENITH: Colour = [0.35, 0.55, 0.86];
const HORIZON: Colour = [0.78, 0.85, 0.92];
const CLOUD: Colour = [0.74, 0.76, 0.78];
/// Height of a storey, and the parts of it that are window, metres and shares.
const STOREY_M: f32 = 3.0;
const WINDOW_ROWS: [f32; 2] = [0.35, 0.8];
/// Share of pixels with a flake before it, in snow.
const FLAKES: f64 = 0.01;

/// Light of one exposure.
pub(super) struct Shader<'a> {
    image: &'a RangeImage,
    channels: usize,
    columns: Vec<ColumnPose>,
    elevations: Vec<(f32, f32)>,
    world_from_sensor: Matrix3<f32>,
    origin_m: Vector3<f64>,
    around: &'a Surroundings<'a>,
}

impl<'a> Shader<'a> {
    pub(super) fn new(caster: &'a Caster, sensor: &Course, around: &'a Surroundings<'a>) -> Self {
        Self {
            image: &caster.image,
            channels: caster.pattern.channels,
            columns: caster.columns_at_end(sensor).collect(),
            elevations: caster.elevations().collect(),
            world_from_sensor: sensor.end.rotation().cast(),
            origin_m: sensor.end.position_m,
            around,
        }
    }

    /// The image whose pixels have these rays.
    pub(super) fn render(
        &self,
        rays: &[(u32, u32)],
        ground: &mut GroundPaint<'_>,
        seed: u64,
    ) -> Vec<u8> {
        let mut random = SplitMix64::new(seed);
        let mut rgb = Vec::with_capacity(3 * rays.len());
        for &(column, channel) in rays {
            let mut colour = self.colour(column as usize, channel as usize, ground);
            if self.around.weather == Weather::Snow && random.chance(FLAKES) {
                colour = mix(colour, SNOW, 0.7);
            }
            // Light adds up linearly, the values of an image do not: gamma 1.8.
            rgb.extend(
                colour.map(|part| (255.0 * part.clamp(0.0, 1.0).powf(1.0 / 1.8)).round() as u8),
            );
        }
        rgb
    }

    fn ray(&self, column: usize, channel: usize) -> usize {
        column.min(self.columns.len() - 1) * self.channels + channel.min(self.channels - 1)
    }

    fn colour(&self, column: usize, channel: usize, ground: &mut GroundPaint<'_>) -> Colour {
        let ray = self.ray(column, channel);
        let (hit, depth_m) = (self.image.hits[ray], self.image.depths_m[ray]);
        let sky = self.sky(channel);
        if hit == MISS {
            return sky;
        }
        let place = self.origin_m
            + (self.world_from_sensor * self.point(column, channel, depth_m)).cast::<f64>();
        let material = match hit {
            GROUND => ground.colour(&place, self.around.weather),
            body => self.paint(body as usize, place.z as f32),
        };
        let normal = self.normal(column, channel);
        let facing = normal.dot(&Vector3::from(SUN).normalize()).max(0.0);
        let is_sunny = self.around.weather == Weather::Sunny;
        let sun = if is_sunny { 1.0 - AMBIENT } else { 0.3 };
        let lit = material
            .map(|part| part * (AMBIENT + (1.0 - AMBIENT - sun) * 0.5 + sun * facing * 1.3));
        mix(lit, sky, 1.0 - (-depth_m / self.haze_m()).exp())
    }

    fn paint(&self, body: usize, height_m: f32) -> Colour {
        match self.around.paints.get(body) {
            Some(Paint::Vehicle(colour) | Paint::Plain(colour)) => *colour,
            Some(Paint::Wall(colour)) => {
                let share = (height_m / STOREY_M).rem_euclid(1.0);
                if (WINDOW_ROWS[0]..WINDOW_ROWS[1]).contains(&share) {
                    mix(*colour, WINDOW, 0.6)
                } else {
                    *colour
                }
            }
            None => [0.5; 3],
        }
    }

    /// Distance at which 1/e of the contrast remains, metres.
    fn haze_m(&self) -> f32 {
        match self.around.weather {
            Weather::Sunny => 900.0,
            Weather::Fog => 17.0,
            Weather::Snow => 120.0,
        }
    }

    fn sky(&self, channel: usize) -> Colour {
        let (_, sine) = self.elevations[channel.min(self.channels - 1)];
        match self.around.weather {
            Weather::Sunny => mix(HORIZON, ZENITH, sine.max(0.0).sqrt()),
            Weather::Fog | Weather::Snow => CLOUD,
        }
    }

    /// Point at a range along a ray, in the axes of the sensor, from its origin.
    fn point(&self, column: usize, channel: usize, range_m: f32) -> Vector3<f32> {
        let column = &self.columns[column.min(self.columns.len() - 1)];
        Vector3::from(column.point_m(self.elevations[channel.min(self.channels - 1)], range_m))
    }

    /// From the point `here` of a ray to that of a neighbour, where both hit the same body.
    fn towards(&self, ray: usize, here: Vector3<f32>, to: (usize, usize)) -> Option<Vector3<f32>> {
        let other = self.ray(to.0, to.1);
        // At the edge of the pattern the neighbour is the ray itself.
        let is_same = other != ray && self.image.hits[other] == self.image.hits[ray];
        is_same.then(|| self.point(to.0, to.1, self.image.depths_m[other]) - here)
    }

    /// Normal of the surface, from the neighbouring rays that hit the same body, in the world.
    fn normal(&self, column: usize, channel: usize) -> Vector3<f32> {
        let ray = self.ray(column, channel);
        let here = self.point(column, channel, self.image.depths_m[ray]);
        let [across, up] = [
            [(column + 1, channel), (column.saturating_sub(1), channel)],
            [(column, channel + 1), (column, channel.saturating_sub(1))],
        ]
        .map(|[next, before]| {
            let forward = self.towards(ray, here, next);
            forward.or_else(|| self.towards(ray, here, before).map(|back| -back))
        });
        // Too few rays on the body for a plane: it counts as level.
        let (Some(across), Some(up)) = (across, up) else {
            return Vector3::z();
        };
        let normal = across.cross(&up);
        // The cross product may point either way. The visible side faces the sensor.
        let faces_away = normal.dot(&here) > 0.0;
        let towards_sensor = if faces_away { -normal } else { normal };
        let length = towards_sensor.norm();
        if length > 0.0 {
            self.world_from_sensor * towards_sensor / length
        } else {
            Vector3::z()
        }
    }
}
