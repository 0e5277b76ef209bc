//! stub
fn main() {
    let s = merganser_sim::scenario::Scenario::parse(include_str!("../scenarios/three.toml")).unwrap();
    let t = std::time::Instant::now();
    for r in merganser_sim::record::record(&s, 2, std::path::Path::new("/tmp/rec")).unwrap() { println!("{r:?}"); }
    println!("{:?}", t.elapsed());
}
