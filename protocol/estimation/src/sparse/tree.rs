//! A factorisation that grows: decides which fronts a new term touches, and eliminates those again.
//!
//! The fronts form a tree; what a front passes to its parent is kept. A change of a term touches the front that holds
//! it and the fronts above: these are dissolved, their variables ordered and eliminated anew, and the untouched
//! subtrees hung below again (Kaess et al. 2012, "iSAM2", §3). A new variable that one term alone ties to known ones,
//! and fully, passes nothing on: it is hung below them and nothing else is touched.
//!
//! What is dissolved is kept until [`CliqueTree::accept`], so that [`CliqueTree::reject`] leaves no trace.

use super::clique::{Clique, Sum};
use super::dense::Scratch;
use super::front::dot;
use crate::geometry::sim3::{Matrix7, Vector7};
use crate::solve_error::SolveError;

/// What stands for "nowhere" in tables by variable.
pub(super) const NONE: usize = usize::MAX;

/// Parts of a sum of squares, by number.
pub(crate) trait Terms {
    /// The variables of a term.
    fn variables(&self, term: usize) -> impl Iterator<Item = usize>;
    /// Adds a term's part of `H` and of the right-hand side `b`.
    fn add(&self, term: usize, sum: &mut Sum<'_>);
}

/// The Cholesky factor of `H`, and the solution `x` of `H x = b`.
#[derive(Debug, Default)]
pub(crate) struct CliqueTree {
    /// By variable: scalars, the first scalar, the clique that eliminates it.
    pub(super) sizes: Vec<usize>,
    pub(super) starts: Vec<usize>,
    pub(super) clique_of: Vec<usize>,
    /// By term: the clique that holds it.
    pub(super) holder: Vec<usize>,
    pub(super) cliques: Vec<Clique>,
    pub(super) roots: Vec<usize>,
    /// Places of no clique.
    pub(super) free: Vec<usize>,
    solution: Vec<f64>,
    /// Since the last [`CliqueTree::accept`]: what was dissolved, and the places of what was put in.
    pub(super) removed: Vec<(usize, Clique)>,
    pub(super) added: Vec<usize>,
    pub(super) scratch: Memory,
}

/// What a change is undone to.
#[derive(Clone, Debug)]
pub(crate) struct Before {
    variables: usize,
    terms: usize,
    roots: Vec<usize>,
}

#[derive(Default)]
pub(super) struct Memory {
    pub(super) dense: Scratch,
    pub(super) square: Vec<f64>,
    pub(super) row_of: Vec<usize>,
}

impl core::fmt::Debug for Memory {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Memory")
    }
}

impl CliqueTree {
    /// A variable without any term yet; its solution is zero.
    pub(crate) fn add_variable(&mut self, size: usize) -> usize {
        self.starts.push(self.solution.len());
        self.sizes.push(size);
        self.clique_of.push(NONE);
        self.solution.resize(self.solution.len() + size, 0.0);
        self.sizes.len() - 1
    }

    /// A term; its number is that of the call.
    pub(crate) fn add_term(&mut self) {
        self.holder.push(NONE);
    }

    /// Number of cliques.
    pub(crate) fn cliques(&self) -> usize {
        self.cliques.len() - self.free.len() - self.removed.len()
    }

    /// Scalars of all variables.
    pub(crate) fn scalars(&self) -> usize {
        self.solution.len()
    }

    /// Numbers of the factor.
    pub(crate) fn value_count(&self) -> usize {
        self.cliques.iter().map(Clique::value_count).sum()
    }

    /// Numbers kept in all.
    pub(crate) fn kept_count(&self) -> usize {
        self.cliques.iter().map(Clique::kept_count).sum()
    }

    /// `bᵀ H⁻¹ b`.
    pub(crate) fn decrease(&self) -> f64 {
        self.cliques.iter().map(Clique::whitened_square).sum()
    }

    /// The solution at a variable.
    pub(crate) fn solution(&self, variable: usize) -> &[f64] {
        &self.solution[self.starts[variable]..][..self.sizes[variable]]
    }

    /// Sets the solution at a variable to zero.
    pub(crate) fn clear_solution(&mut self, variable: usize) {
        self.solution[self.starts[variable]..][..self.sizes[variable]].fill(0.0);
    }

    /// Remembers where [`CliqueTree::reject`] shall return to.
    pub(crate) fn before(&self) -> Before {
        Before { variables: self.sizes.len(), terms: self.holder.len(), roots: self.roots.clone() }
    }

    /// The whole solution.
    pub(crate) fn solutions(&self) -> &[f64] {
        &self.solution
    }

    /// Makes all changes since the last call lasting.
    pub(crate) fn accept(&mut self) {
        self.free.extend(self.removed.drain(..).map(|(id, _)| id));
        for id in self.added.drain(..) {
            self.cliques[id].is_tentative = false;
        }
    }

    /// Undoes all changes since the last [`CliqueTree::accept`]. If known variables moved since, `solution` is what
    /// [`CliqueTree::solutions`] was before.
    pub(crate) fn reject(&mut self, before: Before, solution: Option<Vec<f64>>) {
        for id in core::mem::take(&mut self.added) {
            if core::mem::take(&mut self.cliques[id].is_tentative) {
                let clique = core::mem::take(&mut self.cliques[id]);
                if let Some(parent) = clique.parent {
                    self.cliques[parent].children.retain(|&child| child != id);
                }
                self.free.push(id);
            }
        }
        let mut restored = Vec::with_capacity(self.removed.len());
        for (id, clique) in core::mem::take(&mut self.removed) {
            clique.pivots.iter().for_each(|&variable| self.clique_of[variable] = id);
            clique.terms.iter().for_each(|&term| self.holder[term] = id);
            self.cliques[id] = clique;
            restored.push(id);
        }
        for id in restored {
            for k in 0..self.cliques[id].children.len() {
                let child = self.cliques[id].children[k];
                self.cliques[child].parent = Some(id);
            }
        }
        self.roots = before.roots;
        self.clique_of.truncate(before.variables);
        self.sizes.truncate(before.variables);
        self.starts.truncate(before.variables);
        self.holder.truncate(before.terms);
        let scalars = self.starts.last().zip(self.sizes.last()).map_or(0, |(start, size)| start + size);
        self.solution = solution.unwrap_or_else(|| core::mem::take(&mut self.solution));
        self.solution.truncate(scalars);
    }

    /// All variables that are eliminated so far.
    pub(crate) fn eliminated(&self) -> Vec<usize> {
        (0..self.sizes.len()).filter(|&v| self.clique_of[v] != NONE).collect()
    }

    /// `Aᵀ H⁻¹ A` for seven columns A that are zero but in the rows given as (variable, scalar of it, row): the square
    /// of `L⁻¹ A`, which is zero off the ways from those variables to the roots.
    pub(crate) fn covariance(&self, rows: &[(usize, usize, Vector7)]) -> Matrix7 {
        let n = self.scalars();
        let mut columns = vec![0.0; 7 * n];
        let mut ways: Vec<(usize, Option<usize>, usize)> = Vec::new();
        for (variable, scalar, row) in rows {
            (0..7).for_each(|c| columns[c * n + self.starts[*variable] + scalar] += row[c]);
            let way: Vec<usize> = self.way_up(self.clique_of[*variable]).collect();
            let height = |(k, &id): (usize, &usize)| (way.len() - k, self.cliques[id].pivots.first().copied(), id);
            ways.extend(way.iter().enumerate().map(height));
        }
        ways.sort_unstable();
        ways.dedup();
        let mut out = Matrix7::zeros();
        let mut whitened = vec![Vec::new(); 7];
        for clique in ways.iter().rev().map(|&(.., id)| &self.cliques[id]) {
            let scalars = || clique.variables().flat_map(|v| self.starts[v]..self.starts[v] + self.sizes[v]);
            for (x, column) in whitened.iter_mut().zip(columns.chunks_exact_mut(n)) {
                x.clear();
                x.extend(scalars().map(|k| column[k]));
                clique.whiten(x);
                scalars().zip(x.iter()).for_each(|(k, &value)| column[k] = value);
            }
            for r in 0..7 {
                for c in 0..7 {
                    out[(r, c)] += dot(&whitened[r][..clique.columns], &whitened[c][..clique.columns]);
                }
            }
        }
        out
    }

    /// A clique and all above it.
    fn way_up(&self, clique: usize) -> impl Iterator<Item = usize> + '_ {
        core::iter::successors(self.cliques.get(clique).map(|_| clique), |&id| self.cliques[id].parent)
    }

    /// Hangs a new variable below known ones that one term ties it to, if one clique holds them all. The term must
    /// determine the new variable whatever the others are, and say nothing of them. Returns whether it was done.
    ///
    /// # Errors
    /// [`SolveError`]; nothing has changed then.
    pub(crate) fn hang<T: Terms>(&mut self, terms: &T, variable: usize, term: usize) -> Result<bool, SolveError> {
        let mut below: Vec<usize> = terms.variables(term).filter(|&v| v != variable).collect();
        below.sort_unstable();
        let holds_all = |&id: &usize| {
            let clique = self.cliques.get(id);
            clique.is_some_and(|c| below.iter().all(|v| c.pivots.contains(v) || c.below.contains(v)))
        };
        let parent = below.iter().map(|&v| self.clique_of[v]).find(holds_all);
        if parent.is_none() && !below.is_empty() {
            return Ok(false);
        }
        let mut clique = Clique::new(vec![variable], below, &self.sizes);
        (clique.parent, clique.terms) = (parent, vec![term]);
        self.finish(terms, &mut clique, &[])?;
        clique.pass_nothing();
        let id = self.insert(clique);
        match parent {
            Some(parent) => self.cliques[parent].children.push(id),
            None => self.roots.push(id),
        }
        self.solve_at(id, 0.0, &mut Vec::new());
        Ok(true)
    }

    /// Solves `H x = b` where it may have changed: in new cliques, and below variables that moved. A variable that
    /// would move by less than `tolerance` of its standard deviation given the later ones stays. Returns those that
    /// moved.
    pub(crate) fn substitute(&mut self, tolerance: f64) -> Vec<usize> {
        let mut moved = Vec::new();
        let mut has_moved = vec![false; self.sizes.len()];
        let mut stack = self.roots.clone();
        while let Some(id) = stack.pop() {
            let clique = &self.cliques[id];
            if !(clique.is_fresh || clique.below.iter().any(|&v| has_moved[v])) {
                continue;
            }
            let known = moved.len();
            self.solve_at(id, tolerance, &mut moved);
            moved[known..].iter().for_each(|&v| has_moved[v] = true);
            stack.extend(&self.cliques[id].children);
        }
        moved
    }

    fn solve_at(&mut self, id: usize, tolerance: f64, moved: &mut Vec<usize>) {
        let clique = &mut self.cliques[id];
        clique.is_fresh = false;
        let (mut below, mut own) = (Vec::with_capacity(clique.height - clique.columns), Vec::new());
        for &variable in &clique.below {
            below.extend_from_slice(&self.solution[self.starts[variable]..][..self.sizes[variable]]);
        }
        clique.solution(&below, &mut own);
        let mut first = 0;
        for &variable in &clique.pivots {
            let (start, size) = (self.starts[variable], self.sizes[variable]);
            let (old, new) = (&mut self.solution[start..start + size], &own[first..first + size]);
            let moves = |k: usize| (new[k] - old[k]).abs() * clique.certainty(first + k) > tolerance;
            if (0..size).any(moves) {
                old.copy_from_slice(new);
                moved.push(variable);
            }
            first += size;
        }
    }
}
