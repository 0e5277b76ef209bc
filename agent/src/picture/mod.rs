//! Pictures of a merged map.
