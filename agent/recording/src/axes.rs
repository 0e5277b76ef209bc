//! Which columns of a table of points are x, y and z.

/// The places of x, y, z among the names; else the one that is missing. Upper-case names count where no lower-case one
/// stands.
pub(super) fn of(names: &[&str]) -> Result<[usize; 3], &'static str> {
    let mut places = [0; 3];
    for (place, axis) in places.iter_mut().zip(["x", "y", "z"]) {
        let exact = names.iter().position(|name| *name == axis);
        *place = exact.or_else(|| names.iter().position(|name| name.eq_ignore_ascii_case(axis))).ok_or(axis)?;
    }
    Ok(places)
}
