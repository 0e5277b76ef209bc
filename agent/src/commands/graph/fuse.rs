//! `merganser graph fuse`: two estimates of the same poses, of which nobody knows what they have in common.

use super::write::write;
use super::{BadInput, FuseArgs, counted, read, say};
use anyhow::Result;
use merganser_protocol::estimate::posegraph::marginals;

/// Fuses two tables.
pub fn fuse(args: &FuseArgs) -> Result<bool> {
    let [a, b] = [&args.first, &args.second].map(|path| read::marginals(path));
    let (a, b) = (a?, b?);
    let (first, second) = (args.first.display(), args.second.display());
    let out = marginals::fuse(&a, &b, args.independent).map_err(|error| {
        let [line, other] = error.lines;
        BadInput::told(format!("{first}:{line} and {second}:{other}: {error}"))
    })?;
    if out.both == 0 {
        let told = format!("{first} and {second}: no pose is in both; fused are poses of the same id");
        return Err(BadInput::told(told));
    }
    write(&args.out, &marginals::write(&out.rows))?;
    let [only_first, only_second] = out.only;
    say(&format!(
        "{} in both; {only_first} only in {first} and {only_second} only in {second}, kept as they are",
        counted(out.both, "pose")
    ))?;
    Ok(true)
}
