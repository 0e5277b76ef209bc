//! The bounds of everything that travels, and deserialisers that hold to them: a claimed length is compared with its
//! bound before anything is allocated, so no input of a few bytes can ask for a gigabyte (`docs/LIMITS.md`).

use core::fmt;
use serde::Serializer;
use serde::de::{Deserialize, Deserializer, Error, SeqAccess, Visitor};

/// Length of a frame's header: magic, version, kind.
pub const HEADER_LEN: usize = 4;
/// Longest body of any message, and the most bytes of entries in one of them.
pub const MESSAGE_LEN_MAX: usize = 64 * 1024;
/// What a full message may need beyond [`MESSAGE_LEN_MAX`]: header, hash, counts.
pub const MESSAGE_OVERHEAD_MAX: usize = 64;
/// Longest pose beacon, frame included. The encoding cannot exceed it.
pub const BEACON_LEN_MAX: usize = 160;
/// Longest root announcement, frame included.
pub const HAVE_LEN_MAX: usize = 48;
/// Longest small question or answer (blob request, alignment request and status), frame included.
pub const SMALL_LEN_MAX: usize = 96;
/// Longest log entry, signature included.
pub const ENTRY_LEN_MAX: usize = 2048;
/// Longest payload of a log entry.
pub const PAYLOAD_LEN_MAX: usize = 1900;
/// Facts that one condensed fact carries at most: more than a payload of verdicts, the shortest ones but for
/// lookalikes.
pub const CARRIED_MAX: usize = 120;
/// Longest submap summary.
pub const SUMMARY_LEN_MAX: usize = 400;
/// Longest keypoint blob, hence also the longest piece of one.
pub const BLOB_LEN_MAX: usize = 64 * 1024;
/// Piece of a blob that keeps poses flowing on a slow link, if asked for every 100 ms.
pub const BLOB_PIECE_LEN: usize = 16 * 1024;
/// Values that prove a piece of a blob at most: of each halving of [`BLOB_LEN_MAX`] down to BLAKE3's chunks of 1 KiB two.
pub const PROOF_MAX: usize = 10;
/// Entries in one message at most.
pub const ENTRIES_PER_DELTA_MAX: usize = 1024;
/// Heads in one have-vector at most; a longer vector is sent in windows.
pub const HEADS_MAX: usize = 2048;
/// Robots listed in one have-vector at most: one for each head, and the asker.
pub const MEMBERS_MAX: usize = HEADS_MAX + 1;
/// Fork proofs in one answer at most.
pub const FORKS_PER_DELTA_MAX: usize = 8;
/// Longest signed roster, its signature included.
pub const ROSTER_LEN_MAX: usize = 64 * 1024;
/// Robots in a signed roster at most.
pub const ROSTER_MEMBERS_MAX: usize = 1024;
/// Observers in a signed roster at most.
pub const ROSTER_OBSERVERS_MAX: usize = 64;
/// Revoked keys in a signed roster at most.
pub const ROSTER_REVOKED_MAX: usize = 256;
/// Epochs of one revoked key that can stay.
pub const KEPT_EPOCHS_MAX: usize = 64;

/// Largest coordinate of a translation, in frame units.
pub const TRANSLATION_MAX: f64 = 1e9;
/// Scales between frames lie in `1/SCALE_MAX ..= SCALE_MAX`.
pub const SCALE_MAX: f64 = 1e6;
/// Largest extent of a submap and largest noise scale, in frame units.
pub const LENGTH_MAX: f32 = 1e6;

/// Serialises a byte vector as one run of bytes.
pub(super) fn as_bytes<S: Serializer>(bytes: &[u8], s: S) -> Result<S::Ok, S::Error> {
    s.serialize_bytes(bytes)
}

/// Deserialises at most `MAX` bytes.
pub(super) fn bytes<'de, D: Deserializer<'de>, const MAX: usize>(d: D) -> Result<Vec<u8>, D::Error> {
    struct Bytes<const MAX: usize>;
    impl<const MAX: usize> Visitor<'_> for Bytes<MAX> {
        type Value = Vec<u8>;
        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            write!(f, "at most {MAX} bytes")
        }
        fn visit_bytes<E: Error>(self, bytes: &[u8]) -> Result<Vec<u8>, E> {
            if bytes.len() > MAX {
                return Err(E::invalid_length(bytes.len(), &self));
            }
            Ok(bytes.to_vec())
        }
    }
    d.deserialize_bytes(Bytes::<MAX>)
}

/// Deserialises at most `MAX` elements. No element type used with this has a size of zero on the wire.
pub(super) fn list<'de, D: Deserializer<'de>, T: Deserialize<'de>, const MAX: usize>(d: D) -> Result<Vec<T>, D::Error> {
    struct List<T, const MAX: usize>(core::marker::PhantomData<T>);
    impl<'de, T: Deserialize<'de>, const MAX: usize> Visitor<'de> for List<T, MAX> {
        type Value = Vec<T>;
        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            write!(f, "at most {MAX} elements")
        }
        fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Vec<T>, A::Error> {
            if let Some(claimed) = seq.size_hint()
                && claimed > MAX
            {
                return Err(A::Error::invalid_length(claimed, &self));
            }
            let mut out = Vec::new();
            while let Some(element) = seq.next_element()? {
                if out.len() == MAX {
                    return Err(A::Error::invalid_length(MAX + 1, &self));
                }
                out.push(element);
            }
            Ok(out)
        }
    }
    d.deserialize_seq(List::<T, MAX>(core::marker::PhantomData))
}
