"""What a stage PC is given: unit, rules, accounts, and the script that installs and removes them."""
