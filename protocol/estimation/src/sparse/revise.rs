//! Elimination anew: decides which cliques a change dissolves, in what order their variables follow, and what of the
//! new cliques is kept.
//!
//! Every second level of cliques forgets what it adds to its parent, to halve the memory: a dissolved parent takes its
//! forgetful children with it.

use super::clique::{Clique, Sum};
use super::memory::{self, FACTOR_BYTES_MAX};
use super::order::{self, Elimination, Supernode};
use super::tree::{CliqueTree, Memory, NONE, Terms};
use crate::solve_error::SolveError;

/// What is to be eliminated anew.
struct Top {
    /// Ascending.
    variables: Vec<usize>,
    terms: Vec<usize>,
    /// Untouched children, by their first pivot.
    orphans: Vec<usize>,
    dissolved: Vec<usize>,
}

impl CliqueTree {
    /// Eliminates anew what a change of terms touches: the cliques of the variables `touched`, those that hold the
    /// terms `dirty`, and all above; with `new_variables` and `new_terms`. Returns the number of cliques eliminated.
    ///
    /// # Errors
    /// [`SolveError`]; nothing has changed then.
    pub(crate) fn revise<T: Terms>(
        &mut self,
        terms: &T,
        (touched, dirty): (&[usize], &[usize]),
        (new_variables, new_terms): (&[usize], &[usize]),
    ) -> Result<usize, SolveError> {
        let places = touched.iter().map(|&v| self.clique_of[v]).chain(dirty.iter().map(|&t| self.holder[t]));
        let places: Vec<usize> = places.filter(|&id| id != NONE).collect();
        let top = self.top(&places, new_variables, new_terms);
        let (elimination, local) = self.analyse(terms, &top)?;
        let fresh = self.eliminate(terms, &top, elimination, &local)?;
        let count = fresh.len();
        self.replace(top, fresh);
        Ok(count)
    }

    /// What lies on the way from `places` to the roots, with what is new.
    fn top(&self, places: &[usize], new_variables: &[usize], new_terms: &[usize]) -> Top {
        let mut is_dissolved = vec![false; self.cliques.len()];
        let mut dissolved = Vec::new();
        for &place in places {
            let mut next = Some(place);
            while let Some(id) = next.filter(|&id| !is_dissolved[id]) {
                is_dissolved[id] = true;
                dissolved.push(id);
                next = self.cliques[id].parent;
            }
        }
        // What forgot its part in a parent that is dissolved goes with it; the list grows while it is walked.
        let mut walked = 0;
        while let Some(&id) = dissolved.get(walked) {
            walked += 1;
            for &child in &self.cliques[id].children {
                if self.cliques[child].is_forgetful && !core::mem::replace(&mut is_dissolved[child], true) {
                    dissolved.push(child);
                }
            }
        }
        let (mut variables, mut terms, mut orphans) = (new_variables.to_vec(), new_terms.to_vec(), Vec::<usize>::new());
        for clique in dissolved.iter().map(|&id| &self.cliques[id]) {
            variables.extend_from_slice(&clique.pivots);
            terms.extend_from_slice(&clique.terms);
            orphans.extend(clique.children.iter().filter(|&&child| !is_dissolved[child]));
        }
        variables.sort_unstable();
        terms.sort_unstable();
        // By content, not by place: places depend on what was tried and rejected.
        orphans.sort_unstable_by_key(|&id| self.cliques[id].pivots.first().copied());
        Top { variables, terms, orphans, dissolved }
    }

    /// An order of the top's variables, and by variable its number there.
    fn analyse<T: Terms>(&self, terms: &T, top: &Top) -> Result<(Elimination, Vec<usize>), SolveError> {
        let mut local = vec![NONE; self.sizes.len()];
        top.variables.iter().enumerate().for_each(|(k, &v)| local[v] = k);
        let mut coupled = vec![Vec::new(); top.variables.len()];
        let mut group = Vec::new();
        let mut couple = |variables: &mut dyn Iterator<Item = usize>| {
            group.clear();
            group.extend(variables.map(|v| local[v]));
            group.sort_unstable();
            group.iter().enumerate().for_each(|(k, &v): (usize, &usize)| coupled[v].extend_from_slice(&group[..k]));
        };
        top.terms.iter().for_each(|&term| couple(&mut terms.variables(term)));
        top.orphans.iter().for_each(|&id| couple(&mut self.cliques[id].below.iter().copied()));
        for list in &mut coupled {
            list.sort_unstable();
            list.dedup();
        }
        let sizes: Vec<usize> = top.variables.iter().map(|&v| self.sizes[v]).collect();
        let elimination = order::analyse(&sizes, &coupled, FACTOR_BYTES_MAX)?;
        memory::within(self.bytes_with(&elimination, &sizes), FACTOR_BYTES_MAX)?;
        Ok((elimination, local))
    }

    /// Bytes that the tree takes while these cliques stand beside those they replace.
    fn bytes_with(&self, Elimination { order, supernodes }: &Elimination, sizes: &[usize]) -> u64 {
        let (mut numbers, mut square_max) = (self.kept_count() as u64, 0u64);
        for node in supernodes {
            let columns: u64 = node.pivots.clone().map(|place| sizes[order[place]] as u64).sum();
            let depth: u64 = node.below.iter().map(|&place| sizes[order[place]] as u64).sum();
            let (panel, square) = ((columns + depth).saturating_mul(columns), depth.saturating_mul(depth));
            numbers = numbers.saturating_add(panel).saturating_add(square / 2 + 2 * depth + columns);
            square_max = square_max.max(square);
        }
        memory::bytes(numbers.saturating_add(square_max))
    }

    /// The cliques of an elimination, children before parents; a parent is named by its place among them.
    fn eliminate<T: Terms>(
        &mut self,
        terms: &T,
        top: &Top,
        Elimination { order, supernodes }: Elimination,
        local: &[usize],
    ) -> Result<Vec<Clique>, SolveError> {
        let mut node_of = vec![NONE; self.sizes.len()];
        let mut rank = vec![NONE; order.len()];
        for (k, node) in supernodes.iter().enumerate() {
            for place in node.pivots.clone() {
                rank[order[place]] = place;
                node_of[top.variables[order[place]]] = k;
            }
        }
        let first =
            |variables: &mut dyn Iterator<Item = usize>| variables.min_by_key(|&v| rank[local[v]]).map(|v| node_of[v]);
        let (mut terms_of, mut orphans_of) = (vec![Vec::new(); supernodes.len()], vec![Vec::new(); supernodes.len()]);
        for &term in &top.terms {
            first(&mut terms.variables(term)).into_iter().for_each(|k| terms_of[k].push(term));
        }
        for &id in &top.orphans {
            first(&mut self.cliques[id].below.iter().copied()).into_iter().for_each(|k| orphans_of[k].push(id));
        }
        let mut fresh: Vec<Clique> = Vec::with_capacity(supernodes.len());
        let mut children_of = vec![Vec::new(); supernodes.len()];
        for (k, Supernode { pivots, below, parent }) in supernodes.into_iter().enumerate() {
            let pivots = pivots.map(|place| top.variables[order[place]]).collect();
            let below = below.into_iter().map(|place| top.variables[order[place]]).collect();
            let mut clique = Clique::new(pivots, below, &self.sizes);
            clique.parent = parent;
            clique.terms = core::mem::take(&mut terms_of[k]);
            clique.children = core::mem::take(&mut orphans_of[k]);
            let levels = clique.children.iter().map(|&id| self.cliques[id].level);
            let levels = levels.chain(children_of[k].iter().map(|&child: &usize| fresh[child].level));
            clique.level = levels.max().map_or(0, |level| level + 1);
            let children: Vec<&Clique> = children_of[k].iter().map(|&child: &usize| &fresh[child]).collect();
            self.finish(terms, &mut clique, &children)?;
            children_of[k].iter().for_each(|&child| fresh[child].forget());
            fresh.push(clique);
            parent.into_iter().for_each(|parent| children_of[parent].push(k));
        }
        Ok(fresh)
    }

    /// Sums up a clique's terms and children, those named in it and `more`, and eliminates it.
    pub(super) fn finish<T: Terms>(
        &mut self,
        terms: &T,
        clique: &mut Clique,
        more: &[&Clique],
    ) -> Result<(), SolveError> {
        let Memory { dense, square, row_of } = &mut self.scratch;
        row_of.resize(self.sizes.len(), 0);
        let mut row = 0;
        for variable in clique.variables() {
            row_of[variable] = row;
            row += self.sizes[variable];
        }
        let own_terms = core::mem::take(&mut clique.terms);
        own_terms.iter().for_each(|&term| terms.add(term, &mut Sum { clique: &mut *clique, row_of: &*row_of }));
        clique.terms = own_terms;
        let orphans = core::mem::take(&mut clique.children);
        let children = more.iter().copied().chain(orphans.iter().map(|&id| &self.cliques[id]));
        children.for_each(|child| clique.take_up(child, &self.sizes, row_of));
        clique.children = orphans;
        clique.eliminate(dense, square).map_err(|scalar| {
            let mut end = 0;
            let owns = |&&v: &&usize| {
                end += self.sizes[v];
                end > scalar
            };
            SolveError::Underconstrained { variable: clique.pivots.iter().find(owns).copied().unwrap_or_default() }
        })?;
        if clique.is_finite() { Ok(()) } else { Err(SolveError::NotFinite) }
    }

    /// Puts the fresh cliques in the place of the dissolved ones.
    fn replace(&mut self, top: Top, fresh: Vec<Clique>) {
        for &id in &top.dissolved {
            let mut children = core::mem::take(&mut self.cliques[id].children);
            children.retain(|&child| !self.cliques[child].is_tentative);
            self.cliques[id].children = children;
        }
        for &id in &top.dissolved {
            let clique = core::mem::take(&mut self.cliques[id]);
            if clique.is_tentative {
                self.free.push(id);
            } else {
                self.removed.push((id, clique));
            }
        }
        self.roots.retain(|&id| !self.cliques[id].pivots.is_empty());
        let parents: Vec<Option<usize>> = fresh.iter().map(|clique| clique.parent).collect();
        let added: Vec<usize> = fresh.into_iter().map(|clique| self.insert(clique)).collect();
        for (&id, parent) in added.iter().zip(parents) {
            let parent = parent.map(|k| added[k]);
            self.cliques[id].parent = parent;
            match parent {
                Some(parent) => self.cliques[parent].children.push(id),
                None => self.roots.push(id),
            }
        }
    }

    /// A place for a clique; what it eliminates and holds now points there.
    pub(super) fn insert(&mut self, clique: Clique) -> usize {
        let id = self.free.pop().unwrap_or(self.cliques.len());
        if id == self.cliques.len() {
            self.cliques.push(Clique::default());
        }
        clique.pivots.iter().for_each(|&variable| self.clique_of[variable] = id);
        clique.terms.iter().for_each(|&term| self.holder[term] = id);
        for &child in &clique.children {
            self.cliques[child].parent = Some(id);
        }
        self.cliques[id] = clique;
        self.cliques[id].is_tentative = true;
        self.added.push(id);
        id
    }
}
