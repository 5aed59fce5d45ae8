mod odd_nodes;
mod values;
