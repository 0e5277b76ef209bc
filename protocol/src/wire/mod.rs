//! What travels and what is stored: framed, versioned, strictly decoded messages, and facts parsed once into checked
//! domain types.

pub mod fact;
