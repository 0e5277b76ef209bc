//! Unpacks LZF, with which PCD compresses: runs of literal bytes, and copies of what was unpacked up to 8 KiB before.

/// What is packed, if it is exactly `due` bytes long. Memory grows with what is unpacked, not with what is promised.
pub(super) fn unpack(packed: &[u8], due: usize) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    let mut bytes = packed.iter().copied();
    while let Some(control) = bytes.next() {
        let length = usize::from(control >> 5);
        if length == 0 {
            let run = usize::from(control) + 1;
            let before = out.len();
            out.extend(bytes.by_ref().take(run));
            if out.len() != before + run {
                return None;
            }
        } else {
            let length = 2 + if length == 7 { 7 + usize::from(bytes.next()?) } else { length };
            let back = (usize::from(control & 31) << 8 | usize::from(bytes.next()?)) + 1;
            let start = out.len().checked_sub(back)?;
            // The copy may reach into itself.
            for at in start..start + length {
                out.push(out[at]);
            }
        }
        if out.len() > due {
            return None;
        }
    }
    (out.len() == due).then_some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_and_copies_unpack() {
        // Three literals; 5 bytes from 3 back, reaching into itself; 9 + 7 bytes from 1 back.
        let packed = [2, b'a', b'b', b'c', 3 << 5, 2, 7 << 5, 7, 0];
        let want = [&b"abcabcab"[..], &[b'b'; 16]].concat();
        assert_eq!(unpack(&packed, want.len()), Some(want.clone()));
        for due in [0, want.len() - 1, want.len() + 1] {
            assert_eq!(unpack(&packed, due), None);
        }
        assert_eq!(unpack(&[1 << 5, 0], 3), None, "from before the beginning");
        for cut in 1..packed.len() {
            assert_eq!(unpack(&packed[..cut], want.len()), None);
        }
    }
}
