//! Localizer of a place: PGC with the place's head, or the search of its surfel map.

use std::path::Path;

use perception::inference::Inference;

use crate::map_registration::MapRegistration;
use crate::map_search::MapSearch;
use crate::pgc::{Localize, Localizer, Result};

/// Reads the localizer of a place.
///
/// `head` is the file of a head or of a surfel map, which is searched then and needs no encoder. Poses are registered to
/// `surfel_map` unless its path is empty, and rejected below `min_confidence`. `set` changes PGC's settings.
///
/// # Errors
/// [`crate::pgc::LocalizerError`] names the file and what is wrong with it.
pub fn place_localizer(
    [encoder, head, surfel_map]: [&Path; 3],
    min_confidence: f64,
    inference: Inference,
    set: impl FnOnce(&mut Localizer),
) -> Result<Box<dyn Localize>> {
    let localizer: Box<dyn Localize> = match MapSearch::of_file(head)? {
        Some(mut search) => {
            search.min_confidence = min_confidence;
            Box::new(search)
        }
        None => {
            let mut pgc = Localizer::load(encoder, head, inference)?;
            pgc.solver.min_confidence = min_confidence;
            set(&mut pgc);
            Box::new(pgc)
        }
    };
    // Outermost: near a prediction the registration alone may suffice, without the networks.
    Ok(MapRegistration::of(localizer, surfel_map, min_confidence)?)
}
