"""PEtab problems: tables of conditions, readings and parameters, with SBML or written equations."""
