//! Whose poses are whose, told to people: files of several robots make one graph only if each robot's ids differ.

use super::counted;
use merganser_protocol::estimate::posegraph::fault::PoseName;
use merganser_protocol::estimate::posegraph::g2o::{Parser, Shared, Stated, number_of};
use merganser_protocol::estimate::posegraph::robust::robot_of;
use std::path::{Path, PathBuf};

/// A line of `path` states otherwise what line `first` (counted through all files) states: why, and the cure.
pub fn two_robots(parser: &Parser, files: &[PathBuf], path: &Path, stated: Stated, first: usize) -> String {
    let place = parser.files().place(first);
    let other = files.get(place.file).map(|file| file.display().to_string()).unwrap_or_default();
    let robot = robot_of(stated.0[0]);
    let both = parser.shared(robot).map(|shared| format!(" Both files use {}.", ids(shared))).unwrap_or_default();
    let path = path.display();
    format!(
        "{stated} otherwise than {other}:{}.{both} If these are two robots, give each a letter of its own in the top \
         byte of its ids: `merganser graph split {path} --robots 1 --first {} --out FILE` does. If they are parts of \
         one robot's graph, put them into one file: `cat {other} {path}`",
        place.line,
        char::from(free_letter(robot)),
    )
}

/// Several files say something of the same poses, and no letter tells whose they are.
pub fn doubt(parser: &Parser, files: &[PathBuf]) -> Option<String> {
    let shared = parser.shared(0)?;
    let names: Vec<String> = files.iter().map(|file| file.display().to_string()).collect();
    Some(format!(
        "{}: several of these files use {}, without a robot's letter in their top byte: taken for the same poses. If \
         they are of several robots, give each a letter: `merganser graph split FILE --robots 1 --first b --out FILE`",
        names.join(", "),
        ids(shared)
    ))
}

/// "the ids 0 to 2", as people read them.
fn ids(Shared { first, last, count }: Shared) -> String {
    let name = |id: u64| {
        let name = PoseName(id).to_string();
        name.strip_prefix("pose ").map_or(name.clone(), str::to_owned)
    };
    match number_of(last) - number_of(first) + 1 {
        1 => format!("the id {}", name(first)),
        all if all == count as u64 => format!("the ids {} to {}", name(first), name(last)),
        _ => format!("{} from {} to {}", counted(count, "id"), name(first), name(last)),
    }
}

/// A letter that is not this robot's: b beside one without a letter, which may become a.
fn free_letter(robot: u8) -> u8 {
    if robot.is_ascii_lowercase() && robot < b'z' { robot + 1 } else { b'b' }
}
