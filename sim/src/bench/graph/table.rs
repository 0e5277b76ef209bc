//! The rows as text.

use super::measure::Measured;
use super::peer::Peer;
use std::fmt::Write;

/// How far above the known optimum a minimum may lie, as a share of it.
const OPTIMUM_TOLERANCE: f64 = 1e-6;

/// How far a covariance may be from the peer's.
const MARGINALS_TOLERANCE: f64 = 1e-8;

/// One graph.
pub(super) struct Row {
    pub(super) name: String,
    pub(super) optimum: Option<f64>,
    /// The file's information is not positive definite: isotropic weights stand in its place.
    pub(super) isotropic: bool,
    pub(super) measured: Measured,
    pub(super) peer: Option<Peer>,
    /// By how much our covariances differ from the peer's, as a share of standard deviations, and of how many poses.
    pub(super) marginals: Option<(f64, usize)>,
}

impl Row {
    /// Whether it converged, to the known optimum, and was certified.
    pub(super) fn is_good(&self) -> bool {
        let m = &self.measured;
        let covariances = self.marginals.is_none_or(|(difference, _)| difference <= MARGINALS_TOLERANCE);
        m.converged
            && covariances
            && m.chordal.certificate.certified
            && self.excess().is_none_or(|excess| excess <= OPTIMUM_TOLERANCE)
    }

    /// By what share SE-Sync's cost lies above the known optimum.
    fn excess(&self) -> Option<f64> {
        Some(self.measured.chordal.cost / self.optimum? - 1.0)
    }
}

/// All graphs: minima and certificates, then time beside the peer.
pub(super) fn table(rows: &[Row]) -> String {
    let mut text = format!(
        "{:<40} {:>6} {:>6} {:>16} {:>10} {:>10} {:>9} {:>5} {:>9}\n",
        "SE-Sync's cost", "poses", "edges", "F", "F/opt - 1", "λ_min", "certified", "iter.", "cpu ms"
    );
    for row in rows {
        let (m, c) = (&row.measured, &row.measured.chordal);
        let _ = writeln!(
            text,
            "{:<40} {:>6} {:>6} {:>16.8} {:>10} {:>10} {:>9} {:>5} {:>9.1}",
            tail(&row.name),
            m.poses,
            m.measurements,
            c.cost,
            row.excess().map_or_else(|| "-".to_owned(), |x| format!("{x:.1e}")),
            c.certificate.eigenvalue.map_or_else(|| "-".to_owned(), |x| format!("{x:.1e}")),
            if c.certificate.certified { "yes" } else { "NO" },
            c.iterations,
            1e3 * m.chordal_s
        );
    }
    let _ = writeln!(
        text,
        "\n{:<40} {:>16} {:>5} {:>9} {:>16} {:>16} {:>9} {:>7} {:>10} {:>10} {:>9}",
        "χ²", "χ²", "iter.", "cpu ms", "from certified", "GTSAM χ²", "ms", "ratio", "marg. ms", "GTSAM ms", "ratio"
    );
    for row in rows {
        let m = &row.measured;
        let _ = write!(
            text,
            "{:<40} {:>16.6} {:>5} {:>9.1} {:>16.6}",
            tail(&row.name),
            m.chi2,
            format!("{}{}{}", if row.isotropic { "*" } else { "" }, m.iterations, if m.converged { "" } else { "!" }),
            1e3 * m.solve_s,
            m.chi2_certified
        );
        let _ = match &row.peer {
            Some(p) => writeln!(
                text,
                " {:>16.6} {:>9.1} {:>7.2} {:>10.1} {:>10.0} {:>9.1}",
                p.chi2,
                1e3 * p.solve_s,
                p.solve_s / m.solve_s,
                1e3 * m.marginals_s,
                1e3 * p.marginals_s,
                p.marginals_s / m.marginals_s
            ),
            None => writeln!(text, " {:>16} {:>9} {:>7} {:>10.1}", "-", "-", "-", 1e3 * m.marginals_s),
        };
    }
    for row in rows {
        if let Some((difference, poses)) = row.marginals {
            let _ = writeln!(
                text,
                "{:<40} covariances of {poses} poses are GTSAM's to {difference:.1e} of their standard deviations",
                tail(&row.name)
            );
        }
    }
    text + "F/opt: against the certified optimum of optima.csv; λ_min: smallest eigenvalue of the certificate; cpu: thread \
            time, start, factor and certificate included; ratio: the peer's time over ours; GTSAM starts at the file's \
            values and its marginals are extrapolated where it takes long; !: did not converge; *: \
            with isotropic weights, because the file's information is not positive definite\n"
}

/// The end of a long name, which tells graphs apart.
fn tail(name: &str) -> String {
    let skip = name.chars().count().saturating_sub(40);
    name.chars().skip(skip).collect()
}
