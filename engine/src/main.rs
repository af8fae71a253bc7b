fn main() {
    let (mut s, mut d) = (0, 0);
    for p in std::env::args().skip(1) {
        match endless_gym::trace::Trace::open(p.as_ref()).and_then(|t| endless_gym::trace::replay(&t)) {
            Ok(r) => { s += r.steps; d += r.differences; println!("{p} {} {} {} {:?}", r.episodes, r.steps, r.differences, r.first); }
            Err(e) => println!("{p}: {e}"),
        }
    }
    println!("{s} {d}");
}
