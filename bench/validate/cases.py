"""The published experiments."""

from bench.validate import blade, homogeneous, relaxation, sawtooth, scissors, solids
from bench.validate.case import Case, NotReproduced, Source

REVIEW = Source('Liu et al. 2022, a review', 'doi 10.1186/s10033-022-00767-4, table 2', 'table')
GOKGOL = Source(
    'Gokgol, Basdogan, Canadinc 2012', 'doi 10.1016/j.medengphy.2011.09.030', 'abstract'
)
MAHVASH = Source('Mahvash et al. 2008', 'doi 10.1109/TBME.2007.908069', 'abstract')
ATKINS = Source(
    'Atkins, Xu, Jeronimidis 2004', 'doi 10.1023/B:JMSC.0000021451.17182.86', 'abstract'
)
LIVER_CUTTING = Source('Chanthasopeephan, Desai, Lau 2003', 'doi 10.1114/1.1624601', 'abstract')
TRUTH_CUBE = Source(
    'Kerdok et al. 2003, Truth Cube',
    'doi 10.1016/s1361-8415(03)00008-2; biorobotics.harvard.edu/truthcube/truthcube.html',
    'page',
)
MULTIS = Source(
    'SimTK Multis', 'simtk.org, multis wiki, Specifications/IndentationModeling, rev. 20', 'page'
)
KERDOK = Source('Kerdok, Ottensmeyer, Howe 2006', 'doi 10.1016/j.jbiomech.2005.07.005', 'abstract')
QUADRATIC = Source('scikit-fem', 'quadratic hexahedra of the same law', 'computed')
FAT = Source('Hatt et al. 2023', 'doi 10.1016/j.jmbbm.2023.105924', 'abstract')
LIVER = Source('tissue table of 2019', 'doi 10.1088/1361-6560/ab5010, table 1', 'table')

CASES: dict[str, Case] = {
    case.name: case
    for case in (
        Case(
            'toughness',
            'Steady force of a blade, J times the 5.5 mm of its edge in the tissue, at each '
            'published toughness',
            (REVIEW, GOKGOL),
            0.10,
            'chosen here',
            blade.run_toughness,
        ),
        Case(
            'stiffness',
            'Steady force of a blade does not depend on stiffness',
            (MAHVASH, GOKGOL),
            0.10,
            'chosen here',
            blade.run_stiffness,
        ),
        Case(
            'slicing',
            'Force across and along the edge of a blade that slices, slice/push 0 to 4',
            (ATKINS,),
            0.10,
            'chosen here',
            blade.run_slicing,
        ),
        Case(
            'sawtooth',
            'Force of a crack that runs in steps of 3 mm: its mean is J times the 5.5 mm of edge, '
            'its teeth are as long as the steps, on any mesh and at any rate of frames',
            (
                LIVER_CUTTING,
                Source('step on a linear spring', 'energy J L a of a tooth', 'formula'),
            ),
            0.10,
            'chosen here; turns of loading and sudden unloading are published, the length of a '
            'step is not',
            sawtooth.run_sawtooth,
        ),
        Case(
            'scissors',
            'Torque of scissors over the angle: a blade closes on a sheet that the other supports',
            (MAHVASH,),
            0.10,
            'chosen here; where the mesh has opened the tissue before the edge, the edge goes on '
            'unpaid, by up to a tenth of a millimetre each time',
            scissors.run_scissors,
        ),
        Case(
            'truth-cube',
            'Truth Cube, 80 mm, pressed by 5, 12.5 and 18.25 %: force and field',
            (TRUTH_CUBE, QUADRATIC),
            0.07,
            'chosen here; strains and size are published, the reference is computed at nu 0.49',
            solids.run_cube,
        ),
        Case(
            'half-pressed',
            'Box 30 x 30 x 10 mm pressed to half, nu 0.3: force',
            (MULTIS, QUADRATIC),
            0.05,
            'published spread of the force over meshes; the plate is flat and bonded here, and the '
            'computed force itself falls by 6 % from 2 to 3 elements over the height',
            solids.run_box,
        ),
        Case(
            'sphere',
            'Sphere of 4 mm radius 1 mm deep in a bonded layer: force',
            (
                Source('Sneddon 1965', 'doi 10.1016/0020-7225(65)90019-4', 'formula'),
                Source('Dimitriadis et al. 2002', 'doi 10.1016/S0006-3495(02)75620-8', 'formula'),
            ),
            0.07,
            'chosen here',
            solids.run_sphere,
        ),
        Case(
            'fat',
            'Rise of the shear modulus of fat under compression',
            (FAT,),
            0.20,
            'chosen here; the abstract has no spread',
            homogeneous.run_fat,
        ),
        Case(
            'liver',
            'Stress of liver at its ultimate strain, b 6',
            (LIVER,),
            0.22,
            'spread of the shear modulus in the table',
            homogeneous.run_liver,
        ),
        Case(
            'relaxation',
            'Force after a step of shear, Maxwell model of liver with two terms',
            (
                Source('Liu and Bilston 2000', 'doi 10.1177/0006355X2000037003002', 'abstract'),
                Source('generalised Maxwell model', 'exact answer of the series', 'formula'),
            ),
            0.02,
            'chosen here; the model is published, its terms (0.3 in 0.1 s, 0.3 in 1 s) are not',
            relaxation.run_relaxation,
        ),
        Case(
            'creep',
            'Strain under a constant load, time constants of perfused porcine liver',
            (KERDOK, Source('generalised Maxwell model', 'exact answer of the series', 'formula')),
            0.02,
            'chosen here; the time constants of 1.86 and 51.3 s are published, their shares (the '
            'strain grows by a half in each) are not',
            relaxation.run_creep,
        ),
    )
}

NOT_REPRODUCED = (
    NotReproduced(
        'Force of the Truth Cube, 798 N/m, and its beads',
        TRUTH_CUBE,
        'the indenter of that test and the modulus are not on the page; the tables of the beads '
        'could not be had',
    ),
    NotReproduced(
        'Curves of bovine liver in shear',
        Source('Capilnasiu et al. 2020', 'doi 10.1007/s10237-020-01297-5', 'abstract'),
        'the tables of parameters could not be had',
    ),
    NotReproduced(
        'Human liver pulled to failure at four rates',
        Source('Untaroiu et al. 2015', 'doi 10.1016/j.jmbbm.2014.07.006', 'abstract'),
        'the Ogden parameters could not be had',
    ),
    NotReproduced(
        'Relaxation of porcine liver and kidney after a step',
        Source('Mishra and Cleveland 2024', 'doi 10.3389/fbioe.2024.1386955', 'abstract'),
        'the values could not be had',
    ),
    NotReproduced(
        'Needle: parts of the work',
        Source(
            'Azar and Hayward 2008', 'ISBMS 2008, Estimation of the fracture toughness', 'abstract'
        ),
        'a needle spreads the tissue: it needs tools of a thickness',
    ),
)
