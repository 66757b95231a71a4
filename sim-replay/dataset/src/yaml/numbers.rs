//! Numbers of a YAML document: plain, in lists, or in NumPy's pickled arrays and scalars, which may stand for any number.
//!
//! Readers of data sets call the methods of a field. A node with a tag of Python goes on to [`numpy_tags`], which calls
//! nothing here.

use super::field::YamlField;
use super::node::Value;
use super::numpy_tags::{self, NumpyArray};
use crate::Result;

/// The integer that a float is: ids are written as `-1.0` where they went through an array of floats.
#[expect(clippy::cast_possible_truncation, reason = "an integer below 1e15")]
pub(crate) fn whole(number: f64) -> Option<i64> {
    (number.fract() == 0.0 && number.abs() < 1e15).then_some(number as i64)
}

impl YamlField<'_> {
    /// A finite number, in any notation.
    pub(crate) fn number(&self) -> Result<f64> {
        if numpy_tags::is_python(self.node) && !matches!(self.node.value, Value::Text(_)) {
            return numpy_tags::scalar(self);
        }
        let number = match &self.node.value {
            Value::Integer(value) => Some(*value as f64),
            Value::Float(value) => Some(*value),
            // Numbers may be quoted.
            Value::Text(text) => text.parse().ok(),
            _ => None,
        };
        number
            .filter(|number| number.is_finite())
            .ok_or_else(|| self.expected("a finite number"))
    }

    /// An integer, or a float without fraction.
    pub(crate) fn integer(&self) -> Result<i64> {
        if let Value::Integer(value) = self.node.value {
            return Ok(value);
        }
        let number = self.number().ok().and_then(whole);
        number.ok_or_else(|| self.expected("an integer"))
    }

    /// Exactly `N` finite numbers, as a list or an array with one row or column.
    pub(crate) fn numbers<const N: usize>(&self) -> Result<[f64; N]> {
        let mut numbers = [0.0; N];
        match &self.node.value {
            Value::List(items) if !numpy_tags::is_call(self.node) => {
                if items.len() != N {
                    return Err(self.expected(&format!("{N} numbers")));
                }
                for (index, (number, item)) in numbers.iter_mut().zip(items).enumerate() {
                    *number = match item.value {
                        // The usual case, without the name of the item, which is a new text.
                        Value::Float(value) if value.is_finite() => value,
                        _ => self.child(&index.to_string(), item).number()?,
                    };
                }
            }
            _ if numpy_tags::is_python(self.node) => {
                let (shape, values) = numpy_tags::array(self)?;
                let is_row = shape.iter().filter(|&&size| size != 1).count() <= 1;
                let found = values.as_slice().try_into().ok().filter(|_| is_row);
                numbers = found.ok_or_else(|| {
                    self.error(format!("an array of shape {shape:?}, expected [{N}]"))
                })?;
                if let Some(number) = numbers.iter().find(|number| !number.is_finite()) {
                    return Err(self.error(format!("{number}, expected {N} finite numbers")));
                }
            }
            _ => return Err(self.expected(&format!("a list of {N} numbers"))),
        }
        Ok(numbers)
    }

    /// Numbers in any form: a list, a list of equally long rows, or an array.
    pub(crate) fn array(&self) -> Result<NumpyArray> {
        let items = match &self.node.value {
            Value::List(items) if !numpy_tags::is_call(self.node) => items,
            _ if numpy_tags::is_python(self.node) => return numpy_tags::array(self),
            _ => return Err(self.expected("numbers")),
        };
        let rows = self.items()?;
        let rows = rows.iter().map(Self::row).collect::<Result<Vec<_>>>()?;
        let inner = rows.first().map(|(shape, _)| shape.clone());
        let inner = inner.unwrap_or_default();
        if rows.iter().any(|(shape, _)| *shape != inner) {
            return Err(self.error("rows of different lengths"));
        }
        let shape = [vec![items.len()], inner].concat();
        let values = rows.into_iter().flat_map(|(_, values)| values);
        Ok((shape, values.collect()))
    }

    /// An item of a list: a number, or a row of numbers.
    fn row(&self) -> Result<NumpyArray> {
        match &self.node.value {
            Value::List(items) if !numpy_tags::is_call(self.node) => {
                let numbers = self.items()?;
                let values = numbers.iter().map(Self::number).collect::<Result<_>>()?;
                Ok((vec![items.len()], values))
            }
            Value::Map(_) | Value::List(_) if numpy_tags::is_python(self.node) => {
                numpy_tags::array(self)
            }
            _ => Ok((vec![], vec![self.number()?])),
        }
    }
}
