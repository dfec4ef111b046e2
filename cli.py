from romnav.cli import main

main()
