//! Levenberg-Marquardt on agents and objects in the plane; objects are eliminated, so the linear system has the size of
//! the number of agents.

use std::f64::consts::PI;

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

const MAX_ROUNDS: usize = 40;
/// Iterations end when the relative decrease of the cost is below this.
const CONVERGED: f64 = 1e-9;
/// Residuals beyond so many standard deviations count linearly (Huber).
const HUBER: f64 = 2.5;

/// A planar position and heading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PlanarPose {
    pub(super) x_m: f64,
    pub(super) y_m: f64,
    pub(super) heading_rad: f64,
}

impl PlanarPose {
    /// At a place whose height is left out.
    pub(super) fn new(place: &Vector3<f64>, heading_rad: f64) -> Self {
        Self {
            x_m: place.x,
            y_m: place.y,
            heading_rad,
        }
    }

    /// The place, at height zero.
    pub(super) fn place(&self) -> Vector3<f64> {
        Vector3::new(self.x_m, self.y_m, 0.0)
    }

    fn moved(&self, step: &Vector3<f64>) -> Self {
        Self {
            x_m: self.x_m + step.x,
            y_m: self.y_m + step.y,
            heading_rad: self.heading_rad + step.z,
        }
    }
}

/// Observation of an object by an agent.
#[derive(Debug, Clone, Copy)]
pub(super) struct Observation {
    pub(super) agent: usize,
    pub(super) object: usize,
    /// In the frame of the agent.
    pub(super) seen: PlanarPose,
    /// Inverse variances of x, y and heading.
    pub(super) information: [f64; 3],
}

/// Agents, of which the first is fixed, and objects.
#[derive(Debug)]
pub(super) struct Graph {
    pub(super) agents: Vec<PlanarPose>,
    /// Prior poses of the agents.
    pub(super) priors: Vec<PlanarPose>,
    /// Inverse variances of x, y and heading.
    pub(super) prior_information: [f64; 3],
    pub(super) objects: Vec<PlanarPose>,
    pub(super) observations: Vec<Observation>,
}

/// Normal equations: `H step = -gradient`, in blocks.
struct Equations {
    agents: DMatrix<f64>,
    agent_gradient: DVector<f64>,
    objects: Vec<(Matrix3<f64>, Vector3<f64>)>,
    /// Row block of an agent, object, block.
    mixed: Vec<(usize, usize, Matrix3<f64>)>,
}

impl Graph {
    /// Moves agents and objects to where the observations fit best.
    pub(super) fn optimise(&mut self) {
        let mut damping = 1e-4;
        let mut cost = self.cost();
        for _ in 0..MAX_ROUNDS {
            let Some((agents, objects)) = self.equations().solve(damping) else {
                damping *= 10.0;
                continue;
            };
            let before = (self.agents.clone(), self.objects.clone());
            self.step(&agents, &objects);
            let now = self.cost();
            if now.is_nan() || now > cost {
                (self.agents, self.objects) = before;
                damping *= 10.0;
                continue;
            }
            let gained = cost - now;
            cost = now;
            // Bounded below, so that a few rejected steps raise it again.
            damping = (damping / 10.0).max(1e-12);
            if gained <= CONVERGED * cost {
                break;
            }
        }
    }

    fn step(&mut self, agents: &DVector<f64>, objects: &[Vector3<f64>]) {
        // The ego is fixed, so the unknowns begin with the second agent.
        for (row, agent) in self.agents[1..].iter_mut().enumerate() {
            *agent = agent.moved(&agents.fixed_rows::<3>(3 * row).into_owned());
        }
        for (object, step) in self.objects.iter_mut().zip(objects) {
            *object = object.moved(step);
        }
    }

    fn cost(&self) -> f64 {
        let seen = self.observations.iter().map(|observation| {
            let far = self.weighed(observation).1.sqrt();
            if far <= HUBER {
                far * far
            } else {
                HUBER * (2.0 * far - HUBER)
            }
        });
        let stayed = self.agents.iter().zip(&self.priors).skip(1);
        let stayed = stayed
            .map(|(agent, prior)| squared(&difference(agent, prior), &self.prior_information));
        seen.sum::<f64>() + stayed.sum::<f64>()
    }

    /// Residual of an observation and its square in standard deviations.
    fn weighed(&self, observation: &Observation) -> (Vector3<f64>, f64) {
        let agent = &self.agents[observation.agent];
        let object = &self.objects[observation.object];
        let (sin, cos) = agent.heading_rad.sin_cos();
        let (dx, dy) = (object.x_m - agent.x_m, object.y_m - agent.y_m);
        let turn = object.heading_rad - agent.heading_rad - observation.seen.heading_rad;
        // R^T (object - agent) - seen, in the frame of the agent.
        let residual = Vector3::new(
            cos * dx + sin * dy - observation.seen.x_m,
            -sin * dx + cos * dy - observation.seen.y_m,
            // Front and back of a box are easily confused.
            turn - PI * (turn / PI).round(),
        );
        (residual, squared(&residual, &observation.information))
    }

    fn equations(&self) -> Equations {
        let unknown = 3 * (self.agents.len() - 1);
        let mut equations = Equations {
            agents: DMatrix::zeros(unknown, unknown),
            agent_gradient: DVector::zeros(unknown),
            objects: vec![(Matrix3::zeros(), Vector3::zeros()); self.objects.len()],
            mixed: Vec::with_capacity(self.observations.len()),
        };
        for (row, (agent, prior)) in self.agents.iter().zip(&self.priors).skip(1).enumerate() {
            let information = Matrix3::from_diagonal(&Vector3::from(self.prior_information));
            equations.add_agent(row, &information, &(information * difference(agent, prior)));
        }
        for observation in &self.observations {
            self.add(observation, &mut equations);
        }
        equations
    }

    fn add(&self, observation: &Observation, equations: &mut Equations) {
        let agent = &self.agents[observation.agent];
        let object = &self.objects[observation.object];
        let (sin, cos) = agent.heading_rad.sin_cos();
        let (dx, dy) = (object.x_m - agent.x_m, object.y_m - agent.y_m);
        let (residual, square) = self.weighed(observation);
        // Huber loss by iteratively reweighted least squares.
        let far = square.sqrt();
        let robust = if far <= HUBER { 1.0 } else { HUBER / far };
        let information = Matrix3::from_diagonal(&Vector3::from(observation.information)) * robust;
        // Jacobian by the object: R^T, and 1 for the heading.
        let by_object = Matrix3::new(cos, sin, 0.0, -sin, cos, 0.0, 0.0, 0.0, 1.0);
        let weighed = by_object.transpose() * information;
        let (block, gradient) = &mut equations.objects[observation.object];
        *block += weighed * by_object;
        *gradient += weighed * residual;
        // The ego is no unknown: its observations hold the objects.
        let Some(row) = observation.agent.checked_sub(1) else {
            return;
        };
        // Jacobian by the agent: -R^T, the derivative of R^T by the heading, and -1.
        let (x_turn, y_turn) = (-sin * dx + cos * dy, -cos * dx - sin * dy);
        let by_agent = Matrix3::new(-cos, -sin, x_turn, sin, -cos, y_turn, 0.0, 0.0, -1.0);
        let weighed = by_agent.transpose() * information;
        equations.add_agent(row, &(weighed * by_agent), &(weighed * residual));
        let mixed = weighed * by_object;
        equations.mixed.push((row, observation.object, mixed));
    }
}

impl Equations {
    fn add_agent(&mut self, row: usize, block: &Matrix3<f64>, gradient: &Vector3<f64>) {
        let mut place = self.agents.fixed_view_mut::<3, 3>(3 * row, 3 * row);
        place += block;
        let mut place = self.agent_gradient.fixed_rows_mut::<3>(3 * row);
        place += gradient;
    }

    /// Steps of agents and objects; `None` where a block cannot be inverted.
    fn solve(mut self, damping: f64) -> Option<(DVector<f64>, Vec<Vector3<f64>>)> {
        // Marquardt: damping in proportion to the diagonal does not depend on units.
        for entry in 0..self.agents.nrows() {
            self.agents[(entry, entry)] *= 1.0 + damping;
        }
        let inverses: Option<Vec<Matrix3<f64>>> = (self.objects.iter())
            .map(|(block, _)| {
                let damped = block + Matrix3::from_diagonal(&block.diagonal()) * damping;
                // An object without observations stays where it is.
                if block.trace() == 0.0 {
                    Some(Matrix3::zeros())
                } else {
                    damped.try_inverse()
                }
            })
            .collect();
        let inverses = inverses?;
        // Step: Schur complement, which eliminates the objects.
        for (row, object, block) in &self.mixed {
            let through = block * inverses[*object];
            let mut place = self.agent_gradient.fixed_rows_mut::<3>(3 * row);
            place -= through * self.objects[*object].1;
            for (other_row, _, other) in self.mixed.iter().filter(|(_, other, _)| other == object) {
                let mut place = self.agents.fixed_view_mut::<3, 3>(3 * row, 3 * other_row);
                place -= through * other.transpose();
            }
        }
        let agents = -self.agents.cholesky()?.solve(&self.agent_gradient);
        // Step: the objects by back-substitution.
        for (row, object, block) in &self.mixed {
            self.objects[*object].1 += block.transpose() * agents.fixed_rows::<3>(3 * row);
        }
        let objects = self.objects.iter().zip(inverses);
        let steps = objects.map(|((_, pulled), inverse)| -(inverse * pulled));
        Some((agents, steps.collect()))
    }
}

fn squared(residual: &Vector3<f64>, information: &[f64; 3]) -> f64 {
    residual
        .iter()
        .zip(information)
        .map(|(residual, information)| residual * residual * information)
        .sum()
}

fn difference(one: &PlanarPose, other: &PlanarPose) -> Vector3<f64> {
    let turn = one.heading_rad - other.heading_rad;
    let (x, y) = (one.x_m - other.x_m, one.y_m - other.y_m);
    Vector3::new(x, y, turn.sin().atan2(turn.cos()))
}
