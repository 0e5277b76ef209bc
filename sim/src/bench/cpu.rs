//! Processor time, so that other work on the machine does not count.

/// Processor time that this thread has used, s.
#[cfg(unix)]
pub fn thread_seconds() -> f64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    now.tv_sec as f64 + now.tv_nsec as f64 * 1e-9
}

/// Wall time since the first call, s: there is no portable clock of a thread's own.
#[cfg(not(unix))]
pub fn thread_seconds() -> f64 {
    static START: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    START.get_or_init(std::time::Instant::now).elapsed().as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::thread_seconds;

    #[test]
    fn it_counts_work() {
        let start = thread_seconds();
        let mut sum = 0.0_f64;
        for k in 0..2_000_000 {
            sum += f64::from(std::hint::black_box(k)).sqrt();
        }
        assert!(sum > 0.0 && thread_seconds() > start);
    }
}
