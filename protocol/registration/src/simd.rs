//! The widest instructions that the processor has, chosen while running.

use pulp::Arch;

/// Runs `f` with the widest instructions of the processor. Rust never fuses or reorders arithmetic, so results are the
/// same to the bit with any. What `f` calls is compiled for them only if inlined; the bound makes it a closure that is
/// called once, without a shim that would stand between.
#[inline(always)]
pub(crate) fn wide<R>(arch: Arch, f: impl FnOnce() -> R) -> R {
    arch.dispatch(f)
}
