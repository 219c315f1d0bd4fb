//! Which stage reads what another wrote.
use std::fmt::Write;

use serde::Serialize;

/// A stage in the graph of one configuration.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Node {
    /// Name of the stage and of its folder.
    pub stage: &'static str,
    /// The executable that runs it.
    pub executable: &'static str,
    /// Stages whose outputs it reads under this configuration.
    pub reads: Vec<&'static str>,
    /// Why this configuration does not need it; `None` if it does.
    pub unneeded: Option<&'static str>,
}

/// The stages of one configuration, every one after those that it reads.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Graph {
    nodes: Vec<Node>,
}

impl Graph {
    /// Panics if a stage reads one that does not stand before it: the order is the program's own.
    pub fn new(nodes: Vec<Node>) -> Self {
        for (k, node) in nodes.iter().enumerate() {
            for read in &node.reads {
                let before = nodes[..k].iter().any(|n| n.stage == *read);
                assert!(
                    before,
                    "{} reads {read}, which is not before it",
                    node.stage
                );
            }
        }
        Self { nodes }
    }

    /// All stages, in an order in which they can run.
    pub fn nodes(&self) -> &[Node] {
        &self.nodes
    }

    /// The stage of that name.
    pub fn node(&self, stage: &str) -> Option<&Node> {
        self.nodes.iter().find(|n| n.stage == stage)
    }

    /// `target` and everything that it needs, in order.
    pub fn up_to(&self, target: &str) -> Vec<&Node> {
        let mut needed = vec![target];
        for node in self.nodes.iter().rev() {
            if needed.contains(&node.stage) {
                needed.extend(&node.reads);
            }
        }
        self.named(&needed)
    }

    /// `first` and everything that reads it, directly or not, in order.
    pub fn from(&self, first: &str) -> Vec<&Node> {
        let mut reached = vec![first];
        for node in &self.nodes {
            if node.reads.iter().any(|r| reached.contains(r)) {
                reached.push(node.stage);
            }
        }
        self.named(&reached)
    }

    fn named(&self, names: &[&str]) -> Vec<&Node> {
        let nodes = self.nodes.iter();
        nodes.filter(|n| names.contains(&n.stage)).collect()
    }

    /// One line a stage.
    pub fn to_text(&self) -> String {
        let wide = |f: fn(&Node) -> usize| self.nodes.iter().map(f).max().unwrap_or(0);
        let (names, tools) = (wide(|n| n.stage.len()), wide(|n| n.executable.len()));
        let mut text = String::new();
        for node in &self.nodes {
            let reads = match (node.unneeded, node.reads.is_empty()) {
                (Some(why), _) => format!("not needed: {why}"),
                (None, true) => "reads no other stage".into(),
                (None, false) => format!("reads {}", node.reads.join(", ")),
            };
            let (stage, tool) = (node.stage, node.executable);
            let _ = writeln!(text, "{stage:names$}  {tool:tools$}  {reads}");
        }
        text.truncate(text.trim_end().len());
        text
    }

    /// For Graphviz: `dipir graph --dot | dot -Tsvg`.
    pub fn to_dot(&self) -> String {
        let mut text = String::from("digraph dipir {\n  rankdir=LR;\n  node [shape=box];\n");
        for node in &self.nodes {
            let style = match node.unneeded {
                Some(_) => ", style=dashed",
                None => "",
            };
            let (stage, tool) = (node.stage, node.executable);
            let _ = writeln!(text, "  {stage} [label=\"{stage}\\n{tool}\"{style}];");
        }
        for node in &self.nodes {
            for read in &node.reads {
                let _ = writeln!(text, "  {read} -> {};", node.stage);
            }
        }
        text.push('}');
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(stage: &'static str, reads: &[&'static str]) -> Node {
        Node {
            stage,
            executable: "x",
            reads: reads.into(),
            unneeded: None,
        }
    }

    fn diamond() -> Graph {
        Graph::new(vec![
            node("a", &[]),
            node("b", &[]),
            node("c", &["b"]),
            node("d", &["a", "c"]),
        ])
    }

    fn names(nodes: Vec<&Node>) -> String {
        nodes.iter().map(|n| n.stage).collect()
    }

    #[test]
    fn a_target_brings_what_it_needs_and_nothing_else() {
        assert_eq!(names(diamond().up_to("d")), "abcd");
        assert_eq!(names(diamond().up_to("c")), "bc");
        assert_eq!(names(diamond().up_to("a")), "a");
    }

    #[test]
    fn a_start_brings_what_depends_on_it_and_nothing_else() {
        assert_eq!(names(diamond().from("a")), "ad");
        assert_eq!(names(diamond().from("b")), "bcd");
        assert_eq!(names(diamond().from("d")), "d");
    }

    #[test]
    #[should_panic(expected = "a reads b, which is not before it")]
    fn a_circle_cannot_be_written_down() {
        Graph::new(vec![node("a", &["b"]), node("b", &["a"])]);
    }

    #[test]
    fn dot_has_an_arrow_for_every_read() {
        let text = diamond().to_dot();
        assert_eq!(text.matches(" -> ").count(), 3);
        assert!(
            text.starts_with("digraph dipir {") && text.ends_with('}'),
            "{text}"
        );
    }
}
