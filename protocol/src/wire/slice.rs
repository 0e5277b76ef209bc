//! Pieces of a blob that prove themselves. A blob's address is BLAKE3, which is the root of a tree over chunks of
//! [`CHUNK_LEN`] bytes: with the values of the subtrees beside a piece, anyone can tell from the address alone whether
//! the piece belongs there (the verified slices of the BLAKE3 paper, section 6.4, with the values and without the
//! lengths, which the answer states). So a piece is judged when it comes, whoever sent it, and a false one costs no more
//! than itself.

use crate::ids::Hash;
use blake3::CHUNK_LEN;
use blake3::hazmat::{ChainingValue, HasherExt, Mode, left_subtree_len, merge_subtrees_non_root, merge_subtrees_root};
use core::ops::Range;

/// Pieces begin at a multiple of so many bytes, and end at one or at the end of the blob.
pub const PIECE_STEP: usize = CHUNK_LEN;

/// The values that prove bytes `piece` of `blob`, from the root down, left before right. Empty if `piece` is the whole,
/// or no piece: [`is_aligned`].
pub fn proof(blob: &[u8], piece: Range<usize>) -> Vec<[u8; 32]> {
    let mut values = Vec::new();
    if is_aligned(blob.len(), &piece) && !covers(&piece, 0, blob.len()) {
        let left = left_len(blob.len());
        values_beside(blob, 0..left, &piece, &mut values);
        values_beside(blob, left..blob.len(), &piece, &mut values);
    }
    values
}

/// Whether a range of a blob of `total` bytes can be proved: it is not empty, inside, and begins and ends at a multiple
/// of [`PIECE_STEP`] or at the blob's end.
pub fn is_aligned(total: usize, piece: &Range<usize>) -> bool {
    let ends_well = piece.end == total || piece.end.is_multiple_of(PIECE_STEP);
    piece.start < piece.end && piece.end <= total && piece.start.is_multiple_of(PIECE_STEP) && ends_well
}

/// Whether `bytes` stand at `offset` in the blob of `total` bytes that `address` names, as `proof` shows. What follows
/// the piece is not at hand, so that a false total may pass; a piece that ends the blob by its total does end it.
#[must_use]
pub fn proves(address: Hash, total: usize, offset: usize, bytes: &[u8], proof: &[[u8; 32]]) -> bool {
    let Some(end) = offset.checked_add(bytes.len()) else { return false };
    let piece = offset..end;
    if !is_aligned(total, &piece) {
        return false;
    }
    if covers(&piece, 0, total) {
        return proof.is_empty() && Hash::of(bytes) == address;
    }
    let left = left_len(total);
    let mut values = proof.iter();
    let mut value = |part| value_of(part, bytes, &piece, &mut values);
    let (Some(a), Some(b)) = (value(0..left), value(left..total)) else { return false };
    values.next().is_none() && *merge_subtrees_root(&a, &b, Mode::Hash).as_bytes() == address.0
}

fn covers(piece: &Range<usize>, start: usize, end: usize) -> bool {
    piece.start <= start && end <= piece.end
}

fn is_beside(piece: &Range<usize>, part: &Range<usize>) -> bool {
    part.end <= piece.start || piece.end <= part.start
}

/// Length of the left subtree of a part that has two.
fn left_len(len: usize) -> usize {
    left_subtree_len(len as u64) as usize
}

fn value_at(bytes: &[u8], at: usize) -> ChainingValue {
    blake3::Hasher::new().set_input_offset(at as u64).update(bytes).finalize_non_root()
}

fn values_beside(blob: &[u8], part: Range<usize>, piece: &Range<usize>, values: &mut Vec<[u8; 32]>) {
    if covers(piece, part.start, part.end) {
        return;
    }
    if is_beside(piece, &part) {
        return values.push(value_at(&blob[part.clone()], part.start));
    }
    let middle = part.start + left_len(part.len());
    values_beside(blob, part.start..middle, piece, values);
    values_beside(blob, middle..part.end, piece, values);
}

/// The value of a part that is not the root, from the piece where it lies in it, else from the proof.
fn value_of<'a>(
    part: Range<usize>,
    bytes: &[u8],
    piece: &Range<usize>,
    values: &mut impl Iterator<Item = &'a [u8; 32]>,
) -> Option<ChainingValue> {
    if covers(piece, part.start, part.end) {
        return Some(value_at(&bytes[part.start - piece.start..part.end - piece.start], part.start));
    }
    if is_beside(piece, &part) {
        return values.next().copied();
    }
    let middle = part.start + left_len(part.len());
    let left = value_of(part.start..middle, bytes, piece, values)?;
    let right = value_of(middle..part.end, bytes, piece, values)?;
    Some(merge_subtrees_non_root(&left, &right, Mode::Hash))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::limits::{BLOB_LEN_MAX, PROOF_MAX};
    use proptest::prelude::*;

    fn blob(len: usize) -> Vec<u8> {
        (0..len).map(|k| (k * k / 7 + k) as u8).collect()
    }

    /// A blob, and a piece of it that can be proved.
    fn pieces() -> impl Strategy<Value = (Vec<u8>, Range<usize>)> {
        (1..=BLOB_LEN_MAX, any::<[prop::sample::Index; 2]>()).prop_map(|(len, [from, to])| {
            let start = from.index(len.div_ceil(PIECE_STEP)) * PIECE_STEP;
            let steps = (len - start).div_ceil(PIECE_STEP);
            (blob(len), start..(start + (1 + to.index(steps)) * PIECE_STEP).min(len))
        })
    }

    proptest! {
        #[test]
        fn a_piece_proves_itself_and_nothing_else((blob, piece) in pieces(), flip in any::<prop::sample::Index>()) {
            let (address, values) = (Hash::of(&blob), proof(&blob, piece.clone()));
            let bytes = &blob[piece.clone()];
            prop_assert!(values.len() <= PROOF_MAX);
            prop_assert!(proves(address, blob.len(), piece.start, bytes, &values));
            let mut false_bytes = bytes.to_vec();
            false_bytes[flip.index(bytes.len())] ^= 1;
            prop_assert!(!proves(address, blob.len(), piece.start, &false_bytes, &values));
            // No piece but the last ends the blob.
            prop_assert!(piece.end == blob.len() || !proves(address, piece.end, piece.start, bytes, &values));
            prop_assert!(!proves(address, blob.len(), piece.start + PIECE_STEP, bytes, &values));
            let mut longer = values.clone();
            longer.push([0; 32]);
            prop_assert!(!proves(address, blob.len(), piece.start, bytes, &longer));
            if let Some(shorter) = values.split_last() {
                prop_assert!(!proves(address, blob.len(), piece.start, bytes, shorter.1));
                let mut other = values.clone();
                other[flip.index(values.len())][3] ^= 4;
                prop_assert!(!proves(address, blob.len(), piece.start, bytes, &other));
            }
        }

        /// Whatever is claimed is judged, never a panic.
        #[test]
        fn nonsense_proves_nothing(
            total in 0..2 * BLOB_LEN_MAX, offset in any::<usize>(), len in 0..4096_usize, values in 0..PROOF_MAX,
        ) {
            let values = vec![[7; 32]; values];
            prop_assert!(!proves(Hash([1; 32]), total, offset, &blob(len), &values));
            prop_assert!(!proves(Hash([1; 32]), total, offset % (total + 1), &blob(len), &values));
        }
    }

    #[test]
    fn pieces_off_the_steps_are_none() {
        let blob = blob(5000);
        for piece in [1..1024, 0..1000, 1024..1024, 4096..5001, 0..0] {
            assert!(!is_aligned(blob.len(), &piece) && proof(&blob, piece.clone()).is_empty(), "{piece:?}");
            let bytes = blob.get(piece.clone()).unwrap_or_default();
            assert!(!proves(Hash::of(&blob), blob.len(), piece.start, bytes, &[]), "{piece:?}");
        }
        assert!(is_aligned(5000, &(4096..5000)) && is_aligned(5000, &(0..5000)) && is_aligned(5000, &(1024..3072)));
    }

    #[test]
    fn the_longest_proof_is_of_a_chunk_in_the_middle() {
        let blob = blob(BLOB_LEN_MAX);
        let longest = |len: usize| {
            let starts = (0..BLOB_LEN_MAX - len).step_by(PIECE_STEP);
            starts.map(|start| proof(&blob, start..start + len).len()).max().unwrap()
        };
        assert_eq!((longest(PIECE_STEP), longest(2 * PIECE_STEP)), (6, PROOF_MAX));
    }
}
